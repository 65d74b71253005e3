"""Numerical faults: each training stops at the epoch where it diverges, and neither keeps nor publishes its weights."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import pytest
import torch
from lightning.pytorch.callbacks import Callback
from safetensors.torch import save_file

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.errors import UserError
from envtf_lit.model_folders import save_module
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.train_model import train_model
from envtf_lit.policy import load_policy, save_policy
from envtf_lit.training import trained
from envtf_lit.world_models.fit import publish_world_model
from envtf_lit.world_models.lit import LitWorldModel, lit_world_model, window_data
from envtf_lit.world_models.options import EnsembleOptions, TransformerOptions, WorldModelOptions
from envtf_lit.world_models.store import load_world_model, save_world_model
from envtf_lit.world_models.termination_head import TerminationHead, save_termination
from tests.lightning_runs import QUIET, enter_project, refused
from tests.logs import columns, write
from tests.walker import walker_dataset

LOG = walker_dataset().with_split(0.2, 0)
RUN: dict[str, Any] = dict(updates=6, updates_per_epoch=2, batch_size=8)
MODELS: dict[str, WorldModelOptions] = {
    "transformer": TransformerOptions(layers=1, heads=2, width=16, context=6, **RUN),
    "ensemble": EnsembleOptions(members=2, elites=1, hidden=(8,), weight_decay=(0.0, 0.0), **RUN),
}
CURE = r"lower learning_rate, or look for outliers with `envtf data check`\."

# Lightning 2.6's use of an older jsonargparse's names
pytestmark = pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    save_dataset(LOG, tmp_path / "data/dataset.h5")
    return tmp_path / "data/dataset.h5"


@pytest.mark.parametrize("rate", [10.0, 1e3, 1e6, 1e30])
@pytest.mark.parametrize("kind", MODELS)
def test_a_learning_rate_that_is_far_too_high_ends_in_a_sentence(
    kind: str, rate: float, dataset: Path, tmp_path: Path
) -> None:
    params = Params(threads=1, train_model={kind: replace(MODELS[kind], learning_rate=rate)})
    with pytest.raises(UserError, match=rf"^The {kind} diverged in epoch \d: .*(overflowed|has about 1); {CURE}"):
        train_model(params, tmp_path, progress=False)
    assert not (tmp_path / "models").exists() or not list((tmp_path / "models").rglob("*.*"))


class Poison(Callback):
    """Spoils a weight in the second epoch, where no metric shows it."""

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if trainer.current_epoch == 1:
            next(iter(pl_module.parameters())).data.view(-1)[0] = torch.nan


@pytest.mark.parametrize("kind", MODELS)
def test_the_checkpoint_before_stays_and_the_sentence_says_so(kind: str, dataset: Path, tmp_path: Path) -> None:
    data = window_data(str(dataset), MODELS[kind], seed=0)
    lit, run = lit_world_model(data.observation_dim, data.action_dim, MODELS[kind]), tmp_path / "run"
    given: dict[str, Any] = dict(run=run, target=None, epochs=3, precision="fp32", progress=False, callbacks=[Poison()])
    with (
        pytest.raises(UserError, match=r"in epoch 2: the norm of \S+ is nan.*The epoch before is kept in the run's"),
        trained(lit, data, monitor=lit.monitor, **given),
    ):
        raise AssertionError("nothing is there to publish")
    for checkpoint in run.iterdir():
        saved = torch.load(checkpoint, weights_only=True)
        assert saved["epoch"] == 0
        assert all(value.isfinite().all() for name, value in saved["state_dict"].items() if name != "best_error")


def test_lightnings_command_line_has_the_guard_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    enter_project(tmp_path, monkeypatch)
    sizes = dict(layers=1, heads=2, width=16, context=4, updates=4, updates_per_epoch=2, learning_rate=1e6)
    said = refused(capsys, "model", "fit", "--trainer.logger=false", *QUIET, **sizes)
    assert "diverged in epoch" in said
    assert not list(tmp_path.rglob("*.ckpt")) and not (tmp_path / ".envtf/published").exists()


def test_a_posterior_that_cannot_be_had_ends_in_a_sentence(dataset: Path, tmp_path: Path) -> None:
    data = window_data(str(dataset), MODELS["transformer"], seed=0)
    lit = lit_world_model(data.observation_dim, data.action_dim, MODELS["transformer"])
    assert isinstance(lit, LitWorldModel)
    data.setup("fit")
    lit.model.normaliser.fit(data.train)
    with torch.no_grad():
        for parameter in lit.model.parameters():
            parameter.mul_(1e18)
    with pytest.raises(UserError, match=r"^The transformer diverged in its training: .*; lower"):
        publish_world_model(tmp_path / "model", lit, data, None, {}, {})  # pyright: ignore[reportArgumentType]
    assert not (tmp_path / "model").exists()


# what no sound training leaves is neither written nor read


def spoiled(module: torch.nn.Module, name: str, value: float) -> torch.nn.Module:
    module.state_dict()[name].view(-1)[0] = value
    return module


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("net.0.weight", float("nan")),
        ("net.2.bias", float("-inf")),
        ("observation_mean", float("nan")),
        ("observation_std", 0.0),
        ("observation_std", -1.0),
        ("observation_std", float("inf")),
    ],
)
def test_a_policy_that_is_not_sound_is_neither_written_nor_read(name: str, value: float, tmp_path: Path) -> None:
    actor = spoiled(TanhGaussianActor(3, 2, hidden=(8,)), name, value)
    assert isinstance(actor, TanhGaussianActor)
    with pytest.raises(UserError, match=rf"diverged in its training: {name} is {value:.3g}"):
        save_policy(tmp_path / "policy", actor)
    assert not list(tmp_path.iterdir())
    save_policy(tmp_path / "policy", TanhGaussianActor(3, 2, hidden=(8,)))
    write_weights(tmp_path / "policy", actor)
    with pytest.raises(UserError, match=rf"holds {value} in {name}: the training that wrote it diverged"):
        load_policy(tmp_path / "policy")


def write_weights(folder: Path, module: torch.nn.Module) -> None:
    save_file(dict(module.state_dict()), folder / "weights.safetensors")


@pytest.mark.parametrize("name", ["normaliser.target_std", "normaliser.observation_std", "normaliser.action_std"])
def test_a_world_model_without_a_scale_is_refused(name: str, tmp_path: Path) -> None:
    options = MODELS["ensemble"]
    model = lit_world_model(3, 2, options).best_model
    save_world_model(tmp_path / "model", model)
    write_weights(tmp_path / "model", spoiled(model, name, 0.0))
    with pytest.raises(UserError, match=rf"holds 0\.0 in {name}"):
        load_world_model(tmp_path / "model")


def test_a_termination_head_that_is_not_sound_is_not_written(tmp_path: Path) -> None:
    head = spoiled(TerminationHead(3), "threshold", float("nan"))
    assert isinstance(head, TerminationHead)
    with pytest.raises(UserError, match="the termination_head, diverged in its training: threshold is nan"):
        save_termination(tmp_path / "head", head)
    with pytest.raises(UserError, match=r"std is 0, "):
        save_module(tmp_path / "head", spoiled(TerminationHead(3), "std", 0.0), kind="head", arguments={})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["observations", "rewards", "next_observations"])
@pytest.mark.parametrize("value", [3e38, -1e20])
def test_a_value_whose_square_overflows_is_refused(name: str, value: float, tmp_path: Path) -> None:
    content = columns()
    content[name].reshape(12, -1)[7, -1] = value
    message = rf"'{name}' reaches {re.escape(f'{value:.3g}')} at row 7 \(1 rows in all\), whose square"
    with pytest.raises(UserError, match=message):
        load_dataset(write(tmp_path / "log.h5", {n: np.asarray(c) for n, c in content.items()}))
