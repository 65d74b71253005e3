"""Saving and loading of world models, through a closed registry: no class is imported by a name found in a file."""

from pathlib import Path

from envtf_lit.model_folders import load_module, save_module
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.transformer import EnvironmentTransformer

WORLD_MODELS: dict[str, type[EnvironmentTransformer] | type[EnsembleDynamics]] = {
    "environment_transformer": EnvironmentTransformer,
    "ensemble_dynamics": EnsembleDynamics,
}


def save_world_model(folder: str | Path, model: EnvironmentTransformer | EnsembleDynamics) -> None:
    """Writes `weights.safetensors` and `config.json`."""
    kind = next(name for name, cls in WORLD_MODELS.items() if isinstance(model, cls))
    save_module(folder, model, kind=kind, arguments=model.arguments)


def load_world_model(folder: str | Path, *, fused: bool = False) -> EnvironmentTransformer | EnsembleDynamics:
    """The world model saved in a folder, in eval mode, without gradients.

    Args:
        folder: as `save_world_model` wrote it.
        fused: its steps run through torch.compile: the same numbers up to rounding, in fewer kernels. The first ones
            then take a minute; it pays on a GPU, where launching many small kernels is what takes the time.

    Raises:
        UserError: the folder is missing, damaged, or holds something that is not a world model.
    """
    model = load_module(folder, WORLD_MODELS).requires_grad_(False)
    if fused:
        model.fuse()
    return model
