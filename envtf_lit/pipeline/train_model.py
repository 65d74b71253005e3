"""The stage `train_model`: trains a world model."""

from pathlib import Path
from typing import Any

from envtf_lit.pipeline.params import Params, one_of
from envtf_lit.pipeline.stage import DATASET, WORLD_MODELS, run_settings, run_stage
from envtf_lit.world_models.fit import fit_world_model


def train_model(
    params: Params, root: Path = Path("."), *, name: str | None = None, progress: bool = True
) -> dict[str, Any]:
    """Trains a world model and keeps the weights of least held-out open-loop error: `models/world_model/NAME/`.

    Args:
        params: all options.
        root: of the project.
        name: of the section below `train_model`; None where there is one alone.
        progress: shows a bar.

    Returns:
        As `fit_world_model`.

    Raises:
        UserError: no such section, or the dataset or the folder cannot be read or written.
    """
    name = one_of("train_model", params.train_model, name)
    options = params.train_model[name]
    with run_stage(f"train_model_{name}", params, root):
        return fit_world_model(
            options,
            root / DATASET,
            root / WORLD_MODELS / name,
            seed=params.seed,
            precision=params.precision,
            compile=params.compile,
            settings=run_settings(params, options),
            root=root,
            progress=progress,
        )
