"""Runs that resume to the same bits, start afresh when a parameter changes, and keep the best model."""

import csv
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch
from lightning.pytorch.callbacks import Callback

from envtf_lit.agents.bc import BCOptions
from envtf_lit.agents.cql import CQLOptions
from envtf_lit.agents.et_cql import ETCQLOptions, GuardedRolloutOptions
from envtf_lit.agents.value_gradient import ValueGradientOptions
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.errors import UserError
from envtf_lit.files import read_json, write_json
from envtf_lit.imagination.options import GenerateRolloutsOptions
from envtf_lit.model_folders import load_weights
from envtf_lit.pipeline.generate_rollouts import generate_rollouts
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.train_model import train_model
from envtf_lit.pipeline.train_policy import train_policy, within_reach
from envtf_lit.pipeline.yaml import params_yaml, preset_params
from envtf_lit.training import run_folder, trained
from envtf_lit.world_models.forecast import Scale, open_loop_error, segments
from envtf_lit.world_models.lit import SELECTION_HORIZON, SELECTION_SEGMENTS, lit_world_model, window_data
from envtf_lit.world_models.options import TransformerOptions
from envtf_lit.world_models.store import load_world_model
from envtf_lit.world_models.transformer import EnvironmentTransformer
from tests.walker import walker_dataset

LOG = walker_dataset().with_split(0.2, 0)
MODEL = TransformerOptions(
    layers=1, heads=2, width=16, context=6, dropout=0.1, updates=12, updates_per_epoch=4, batch_size=8
)
SIZES: dict[str, Any] = dict(updates=40, updates_per_epoch=10, batch_size=16, hidden=(16, 16), warm_start=0.25)
ET_CQL = ETCQLOptions(
    **SIZES,
    critic_updates=15,
    rollouts=GuardedRolloutOptions(history=2),
    value_gradient=ValueGradientOptions(updates=15, rollouts=5, horizon=3),
)
TINY = Params(
    threads=1,
    train_model={"transformer": MODEL},
    generate_rollouts=GenerateRolloutsOptions(branches=30, horizon=3),
    train_policy={"bc": BCOptions(**SIZES), "cql": CQLOptions(**SIZES), "et_cql": ET_CQL},
)
WORLD_MODEL = Path("models/world_model/transformer")


class Killed(Exception):
    """Stands for a process that dies."""


class Killer(Callback):
    """Dies in the middle of the epoch of that index."""

    def __init__(self, epoch: int) -> None:
        self.epoch = epoch

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: object) -> None:
        if trainer.current_epoch == self.epoch:
            raise Killed


class Idle(Callback):
    """Refuses to see any training."""

    def on_train_batch_start(self, *_: object) -> None:
        raise AssertionError("there was nothing left to train")


class Norms(Callback):
    """Notes how large the gradients are that a step was made with."""

    def __init__(self) -> None:
        self.seen = list[float]()

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: object) -> None:
        gradients = [weight.grad.norm() for weight in pl_module.parameters() if weight.grad is not None]
        self.seen.append(torch.stack(gradients).norm().item())


@pytest.fixture
def root(tmp_path: Path) -> Path:
    save_dataset(LOG, tmp_path / "data/dataset.h5")
    return tmp_path


def train_with(monkeypatch: pytest.MonkeyPatch, callback: Callback) -> None:
    trainer = L.Trainer
    monkeypatch.setattr(
        "envtf_lit.training.L.Trainer",
        lambda **kwargs: trainer(**{**kwargs, "callbacks": [*kwargs["callbacks"], callback]}),
    )


def kill_in_epoch(monkeypatch: pytest.MonkeyPatch, epoch: int) -> None:
    train_with(monkeypatch, Killer(epoch))


def killed(*_: object, **__: object) -> None:
    raise Killed


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def train_whole(root: Path, params: Params = TINY) -> dict[str, bytes]:
    train_model(params, root, progress=False)
    return bytes_of(root / WORLD_MODEL)


def killed_run(root: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a run that was killed in its third epoch."""
    with monkeypatch.context() as patch:
        kill_in_epoch(patch, 2)
        with pytest.raises(Killed):
            train_whole(root)
    (run,) = (root / ".envtf/runs").iterdir()
    return run


def test_a_killed_model_run_resumes_to_the_same_bits(root, monkeypatch):
    expected = train_whole(root)
    run = killed_run(root, monkeypatch)
    assert torch.load(run / "last.ckpt", weights_only=True)["epoch"] == 1
    assert train_whole(root) == expected
    assert not run.exists()


def test_a_kill_followed_by_another_parameter_trains_afresh(root, monkeypatch):
    with monkeypatch.context() as patch:
        kill_in_epoch(patch, 2)
        with pytest.raises(Killed):
            train_whole(root)
    changed = replace(TINY, seed=1)
    after_kill = train_whole(root, changed)
    assert after_kill == train_whole(root, changed)


def test_the_kept_model_is_the_one_of_least_open_loop_error(root):
    metrics = train_model(TINY, root, progress=False)
    with (root / WORLD_MODEL / "curves.csv").open() as stream:
        errors = [float(row["val/open_loop_error"]) for row in csv.DictReader(stream)]
    assert len(errors) == 3 and metrics["open_loop_error"] == min(errors)


@pytest.fixture(scope="module")
def imagined(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project that has all that policies are trained from."""
    root = tmp_path_factory.mktemp("imagined")
    save_dataset(LOG, root / "data/dataset.h5")
    train_model(TINY, root, progress=False)
    train_policy(TINY, root, name="bc", progress=False)
    generate_rollouts(TINY, root, progress=False)
    return root


@pytest.mark.parametrize(
    ("name", "epoch"),
    [("bc", 2), ("cql", 2), ("et_cql", 1), ("et_cql", 2), ("et_cql", 3)],  # after the warm start, amid the rest
)
def test_a_killed_policy_run_resumes_to_the_same_bits(imagined, monkeypatch, name, epoch):
    train = lambda: train_policy(TINY, imagined, name=name, progress=False)  # noqa: E731
    train()
    expected = bytes_of(imagined / "models/policy" / name)
    with monkeypatch.context() as patch:
        kill_in_epoch(patch, epoch)
        with pytest.raises(Killed):
            train()
    (run,) = (imagined / ".envtf/runs").iterdir()
    saved = torch.load(run / "last.ckpt", weights_only=True)
    assert saved["epoch"] == epoch - 1
    if name == "et_cql":
        assert saved["state_dict"]["source.ring.count"] > 0
    train()
    assert bytes_of(imagined / "models/policy" / name) == expected


def test_compiled_training_learns_what_plain_training_learns(root, monkeypatch):
    weights, compiled, original = [], [], torch.compile

    def through_dynamo(function, **options):
        compiled.append(function)
        return original(function, backend="eager")

    monkeypatch.setattr(torch, "compile", through_dynamo)
    options = replace(MODEL, dropout=0.0)
    for compile in (False, True):
        params = replace(TINY, precision="fp32", compile=compile, train_model={"transformer": options})
        train_model(params, root, progress=False)
        weights.append(load_world_model(root / WORLD_MODEL).state_dict())
    assert len(compiled) == 1
    torch.testing.assert_close(weights[1], weights[0])


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_gradients_are_clipped_before_a_step_in_one_pass(root, precision, monkeypatch, capsys):
    monkeypatch.setattr(torch.cpu, "get_capabilities", dict)
    data = window_data(str(root / "data/dataset.h5"), MODEL, seed=0)
    lit = lit_world_model(data.observation_dim, data.action_dim, MODEL)
    norms = Norms()
    with trained(
        lit,
        data,
        run=root / "run",
        target=None,
        epochs=1,
        precision=precision,
        progress=False,
        gradient_clip=1e-3,
        callbacks=[norms],
    ):
        pass
    assert norms.seen == pytest.approx([1e-3] * MODEL.updates_per_epoch, rel=1e-2)
    assert lit.configure_optimizers()["optimizer"].defaults["fused"]
    said = "This cpu is not known to multiply bf16, and may emulate it slowly: take precision: auto."
    assert (said in " ".join(capsys.readouterr().err.split())) is (precision == "bf16")


def test_gradient_steps_are_those_asked_for(root):
    train_policy(TINY, root, name="cql", progress=False)
    with (root / "models/policy/cql/curves.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["epoch"] for row in rows] == ["1", "2", "3", "4"]
    assert rows[0]["train/clone_loss"] and not rows[0]["train/bellman_loss"]  # the warm start is the first epoch
    assert rows[2]["train/bellman_loss"]


def test_run_folders_differ_by_parameters_and_by_bytes(tmp_path):
    data = tmp_path / "data.h5"
    data.write_bytes(b"one")
    first = run_folder(tmp_path, "stage", {"seed": 0}, [data])
    assert first == run_folder(tmp_path, "stage", {"seed": 0}, [data])
    assert first != run_folder(tmp_path, "stage", {"seed": 1}, [data])
    data.write_bytes(b"two")
    assert first != run_folder(tmp_path, "stage", {"seed": 0}, [data])


def test_the_training_metric_is_what_the_saved_model_scores(root):
    metrics = train_model(TINY, root, progress=False)
    training, held_out = LOG.split()
    stretches = segments(held_out.validation_and_test()[0], SELECTION_SEGMENTS, SELECTION_HORIZON, seed=TINY.seed)
    error = open_loop_error(load_world_model(root / WORLD_MODEL), stretches, Scale.of(training))
    assert error == pytest.approx(metrics["open_loop_error"], rel=1e-5)


@pytest.mark.slow
def test_two_processes_with_one_seed_write_the_same_bytes(tmp_path):
    outputs = []
    for name in ("one", "two"):
        save_dataset(LOG, tmp_path / name / "data/dataset.h5")
        (tmp_path / name / "params.yaml").write_text(params_yaml(TINY))
        for stage in (["train_model"], ["train_policy", "bc"], ["generate_rollouts"], ["train_policy", "et_cql"]):
            subprocess.run([sys.executable, "-m", "envtf_lit", *stage, "--quiet"], cwd=tmp_path / name, check=True)
        written = [p for p in sorted((tmp_path / name).rglob("*")) if p.is_file() and ".envtf" not in p.parts]
        outputs.append({str(p.relative_to(tmp_path / name)): p.read_bytes() for p in written})
    assert len(outputs[0]) > 12 and outputs[0] == outputs[1]


def test_a_run_that_diverges_keeps_the_epoch_before(root):
    """The learning rate comes after the warm start, which is the first epoch."""
    params = replace(TINY, train_policy={"cql": CQLOptions(**SIZES, critic_learning_rate=1e30)})
    with pytest.raises(UserError, match=r"^CQL diverged in epoch 2: .*raise cql_weight, or lower critic_learning_rate"):
        train_policy(params, root, name="cql", progress=False)
    (run,) = (root / ".envtf/runs").iterdir()
    saved = torch.load(run / "last.ckpt", weights_only=True)
    assert saved["epoch"] == 0 and all(value.isfinite().all() for value in saved["state_dict"].values())
    assert not (root / "models/policy/cql").exists()


def test_policies_imagine_no_further_than_the_model_reaches(imagined, capsys):
    model = imagined / "models/world_model/transformer"
    reach = read_json(model / "metrics.json")["open_loop_0.1_median"]
    assert 0 <= reach <= 100
    rollouts = GuardedRolloutOptions(value_expansion=50)
    wide = replace(ET_CQL, rollouts=rollouts, value_gradient=ValueGradientOptions(updates=5))
    history = wide.rollouts.history
    for steps, expansion, horizon in ((7, 6, 7), (1, 0, history), (100, 50, 16)):
        write_json(model / "metrics.json", read_json(model / "metrics.json") | {"open_loop_0.1_median": steps})
        cut = within_reach(wide, model)
        assert list(cut.path_lengths.values()) == [expansion, horizon]
        note = capsys.readouterr().err
        assert note.endswith(
            f"reaches {steps} step{'' if steps == 1 else 's'} before its error passes 0.1 (open_loop_0.1_median), so "
            f"paths are shortened: rollouts.value_expansion is {expansion}, not 50 and value_gradient.horizon is "
            f"{horizon}, not 16; for longer ones train the model on more updates or more data.\n"
        ) is (steps < 50) and (note == "") is (steps > 50)
    metrics = {
        name: value for name, value in read_json(model / "metrics.json").items() if name != "open_loop_0.1_median"
    }
    write_json(model / "metrics.json", metrics)  # as earlier versions wrote it
    assert within_reach(wide, model) == wide
    write_json(model / "metrics.json", metrics | {"open_loop_0.1_median": reach})


@pytest.mark.slow
def test_the_papers_model_learns_a_step():
    options = preset_params("paper").train_model["transformer"]
    assert isinstance(options, TransformerOptions)
    model = EnvironmentTransformer(27, 8, **asdict(options.model))
    assert 95e6 < sum(p.numel() for p in model.parameters()) < 105e6
    B, T = options.batch_size, options.context
    batch = dict(
        observations=torch.randn(B, T, 27),
        actions=torch.randn(B, T, 8),
        next_observations=torch.randn(B, T, 27),
        rewards=torch.randn(B, T),
        mask=torch.ones(B, T),
    )
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss = model.loss(batch)
    loss.backward()
    assert torch.isfinite(loss)
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in model.parameters())


def test_saved_models_come_back_whole(root):
    train_whole(root)
    model = load_world_model(root / WORLD_MODEL)
    again = load_world_model(root / WORLD_MODEL)
    load_weights(again, root / WORLD_MODEL / "weights.safetensors")
    assert not model.training
    assert all(torch.equal(a, b) for a, b in zip(model.state_dict().values(), again.state_dict().values(), strict=True))
