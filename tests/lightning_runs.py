"""`envtf model` and `envtf agent` on a small project: what their tests share."""

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from envtf_lit.cli.main import main
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.world_models.store import load_world_model
from envtf_lit.world_models.transformer import EnvironmentTransformer
from tests.walker import walker_dataset

SIZES = {
    "model": {"layers": 1, "heads": 2, "width": 16, "context": 4, "batch_size": 8},
    "agent": {"hidden": [8], "warm_start": 0.5, "batch_size": 8},
}
ENSEMBLE = {"members": 3, "elites": 2, "hidden": [8], "weight_decay": [0, 0], "batch_size": 8}
STILL = 1e-30  # a learning rate too small to change any bit
RUN = {"model": {"updates_per_epoch": 2, "updates": 4}, "agent": {"updates_per_epoch": 10, "updates": 20}}
QUIET = ["--trainer.enable_progress_bar=false", "--trainer.enable_model_summary=false"]
NO_LOGGER = "--trainer.logger=false"


def enter_project(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Makes a project whose dataset has actions in [-2, 2], and enters it."""
    limit = np.full(3, 2.0, np.float32)
    save_dataset(replace(walker_dataset(), action_low=-limit, action_high=limit), folder / "data/dataset.h5")
    monkeypatch.chdir(folder)
    return folder


def envtf(kind: str, verb: str, *flags: str, **options: object) -> None:
    """Runs a Lightning command line on the project's dataset; a fit has `.envtf/published` to itself."""
    if verb == "fit":
        shutil.rmtree(".envtf/published", ignore_errors=True)  # an earlier one, beside which it would go
    main([kind, verb, "--data.path", "data/dataset.h5", *QUIET, *flags, *named(options)])


def named(options: Mapping[str, object]) -> list[str]:
    """Options of the model as flags."""
    return [f"--model.options.{name}={value}" for name, value in options.items()]


def fit(kind: str, *flags: str, **options: object) -> None:
    envtf(kind, "fit", NO_LOGGER, *flags, **{**SIZES[kind], **RUN[kind], **options})


def fit_ensemble(*flags: str, **options: object) -> None:
    envtf("model", "fit", NO_LOGGER, *flags, **{**ENSEMBLE, **RUN["model"], **options})


def refused(capsys: pytest.CaptureFixture[str], kind: str, verb: str, *flags: str, **options: object) -> str:
    """The one sentence with which a command ends in status 2."""
    with pytest.raises(SystemExit) as stop:
        envtf(kind, verb, *flags, **options)
    assert stop.value.code == 2
    errors = capsys.readouterr().err.strip().splitlines()
    assert "Traceback" not in "\n".join(errors)
    return errors[-1]


def same(first: torch.nn.Module, second: torch.nn.Module) -> bool:
    a, b = first.state_dict(), second.state_dict()
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def transformer(folder: str) -> EnvironmentTransformer:
    """The Environment Transformer that was published there."""
    model = load_world_model(folder)
    assert isinstance(model, EnvironmentTransformer)
    return model
