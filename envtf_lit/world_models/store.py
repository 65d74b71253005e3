"""Saving and loading of world models, through a closed registry: no class is imported by a name found in a file."""

from pathlib import Path

import torch

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.errors import UserError
from envtf_lit.model_folders import load_module, save_module
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.transformer import EnvironmentTransformer

FAR = 10.0  # standard deviations of the states that a model learned from, within which another log's states lie
WORLD_MODELS: dict[str, type[EnvironmentTransformer] | type[EnsembleDynamics]] = {
    "environment_transformer": EnvironmentTransformer,
    "ensemble_dynamics": EnsembleDynamics,
}


def save_world_model(folder: str | Path, model: EnvironmentTransformer | EnsembleDynamics) -> None:
    """Writes `weights.safetensors` and `config.json`."""
    kind = next(name for name, cls in WORLD_MODELS.items() if isinstance(model, cls))
    save_module(folder, model, kind=kind, arguments=model.arguments)


def load_world_model(
    folder: str | Path, *, fused: bool = False, dataset: OfflineDataset | None = None
) -> EnvironmentTransformer | EnsembleDynamics:
    """The world model saved in a folder, in eval mode, without gradients.

    Args:
        folder: as `save_world_model` wrote it.
        fused: its steps run through torch.compile: the same numbers up to rounding, in fewer kernels. The first ones
            then take a minute; it pays on a GPU, where launching many small kernels is what takes the time.
        dataset: whose states it is to go on from; None asks nothing of the model.

    Raises:
        UserError: the folder is missing, damaged, or holds something that is not a world model; or one of other
            dimensions than the dataset's, or of states so different that it would see nothing like what it learned.
    """
    model = load_module(folder, WORLD_MODELS).requires_grad_(False)
    if dataset is not None:
        _check_match(folder, model, dataset)
    if fused:
        model.fuse()
    return model


def _check_match(folder: str | Path, model: EnvironmentTransformer | EnsembleDynamics, dataset: OfflineDataset) -> None:
    theirs, ours = (model.observation_dim, model.action_dim), (dataset.observation_dim, dataset.action_dim)
    if theirs != ours:
        raise UserError(
            f"{folder} is a world model of {theirs[0]} observations and {theirs[1]} actions, and the dataset has "
            f"{ours[0]} and {ours[1]}: train one on this dataset (`envtf train_model`)."
        )
    learned, states = model.normaliser, dataset.statistics.observations
    mean, std = learned.observation_mean.cpu().double(), learned.observation_std.cpu().double()
    far = torch.maximum((states.mean - mean).abs(), states.std) / std * states.live
    odd = int(far.argmax())
    if far[odd] > FAR:
        raise UserError(
            f"{folder} learned from other states: dimension {odd} was {mean[odd]:.3g} ± {std[odd]:.3g}, and is "
            f"{states.mean[odd]:.3g} ± {states.std[odd]:.3g} in this dataset; train one on it (`envtf train_model`)."
        )
