"""The stage `train_model`: trains the world model."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.stage import DATASET, WORLD_MODEL, run_settings, run_stage
from envtf_lit.world_models.fit import fit_world_model


def train_model(params: Params, root: Path = Path("."), *, progress: bool = True) -> dict[str, Any]:
    """Trains the world model and keeps the weights of least held-out open-loop error: `models/world_model/`."""
    with run_stage("train_model", params, root):
        return fit_world_model(
            params.train_model,
            root / DATASET,
            root / WORLD_MODEL,
            seed=params.seed,
            precision=params.precision,
            compile=params.compile,
            settings=run_settings(params, asdict(params.train_model)),
            root=root,
            progress=progress,
        )
