"""From the last update to the published folder: no training is lost there, nor for a checkpoint that is damaged."""

import errno
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pytest
import torch

from envtf_lit.data.sources.files import save_dataset
from envtf_lit.errors import UserError
from envtf_lit.pipeline.generate_rollouts import generate_rollouts
from envtf_lit.pipeline.train_model import train_model
from envtf_lit.pipeline.train_policy import train_policy
from envtf_lit.training import WholeCheckpoints
from envtf_lit.world_models.options import EnsembleOptions
from tests.test_training import (
    IMAGINATION,
    POLICY,
    TINY,
    Idle,
    Killed,
    bytes_of,
    kill_in_epoch,
    killed,
    train_both,
    train_with,
)
from tests.walker import walker_dataset


@pytest.fixture
def root(tmp_path: Path) -> Path:
    save_dataset(walker_dataset(), tmp_path / "data/dataset.h5")
    return tmp_path


ENSEMBLE = EnsembleOptions(
    members=3, elites=2, hidden=(8,), weight_decay=(0.0, 0.0), updates=40, updates_per_epoch=4, patience=1
)
SELECTED = replace(POLICY, imagination=replace(IMAGINATION, selection_episodes=2, selection_steps=5))
# stage, parameters, what it writes, the files it keeps until that is done, and where it is killed
GAPS = {
    "model": ("train_model", TINY, "models/world_model", {"best.ckpt", "last.ckpt"}, "world_models.fit.replacing"),
    "ensemble": (
        "train_model",
        replace(TINY, train_model=replace(TINY.train_model, ensemble=ENSEMBLE)),
        "models/world_model",
        {"last.ckpt"},
        "world_models.fit.replacing",
    ),
    "uncertainty": (
        "train_model",
        TINY,
        "models/world_model",
        {"best.ckpt", "last.ckpt"},
        "world_models.lit.LitWorldModel.fit_uncertainty",
    ),
    "clone": ("generate_rollouts", TINY, "models/behaviour", {"last.ckpt"}, "pipeline.generate_rollouts.replacing"),
    "rollouts": (
        "generate_rollouts",
        TINY,
        "models/behaviour",
        {"last.ckpt"},
        "pipeline.generate_rollouts.save_rollouts",
    ),
    "policy": (
        "train_policy",
        replace(TINY, train_policy=replace(TINY.train_policy, et_cql=SELECTED)),
        "models/policy/et_cql",
        {"best.ckpt", "last.ckpt"},
        "agents.store.replacing",
    ),
}


@pytest.mark.parametrize("gap", GAPS)
def test_a_kill_between_training_and_publication_loses_no_training(root, monkeypatch, gap):
    name, params, target, kept, place = GAPS[gap]
    if name != "train_model":
        train_model(TINY, root, progress=False)
    if name == "train_policy":
        generate_rollouts(TINY, root, progress=False)
    stage = getattr(import_module(f"envtf_lit.pipeline.{name}"), name)
    metrics = stage(params, root, progress=False)
    expected = bytes_of(root / target)
    assert list((root / ".envtf/runs").iterdir()) == []
    with monkeypatch.context() as patch:
        patch.setattr(f"envtf_lit.{place}", killed)
        with pytest.raises(Killed):
            stage(params, root, progress=False)
    (run,) = (root / ".envtf/runs").iterdir()
    assert {path.name for path in run.iterdir()} == kept
    with monkeypatch.context() as patch:
        train_with(patch, Idle())
        assert stage(params, root, progress=False) == metrics
    assert bytes_of(root / target) == expected and not run.exists()


def folder_is_a_file(target: Path) -> str:
    target.write_text("mine")
    return "a file of that name stands there"


def parent_is_a_file(target: Path) -> str:
    target.parent.rmdir()
    target.parent.write_text("mine")
    return "is a file, not a folder"


def dangling_link(target: Path) -> str:
    target.symlink_to("nowhere")
    return "a link to nowhere"


@pytest.mark.parametrize("obstacle", [folder_is_a_file, parent_is_a_file, dangling_link])
@pytest.mark.parametrize("target", ["models/world_model", "models/policy/cql", "models/behaviour"])
def test_a_target_that_cannot_be_written_is_refused_before_training(root, monkeypatch, obstacle, target):
    (root / target).parent.mkdir(parents=True)
    said = obstacle(root / target)
    train_with(monkeypatch, Idle())
    train = {
        "models/world_model": lambda: train_model(TINY, root, progress=False),
        "models/policy/cql": lambda: train_policy(TINY, root, algorithm="cql", progress=False),
        "models/behaviour": lambda: generate_rollouts(TINY, root, progress=False),
    }[target]
    with pytest.raises(UserError, match=said):
        train()
    assert not (root / ".envtf/runs").exists()


@pytest.mark.parametrize("closed", ["models", ".envtf/runs"])
def test_a_read_only_folder_is_refused_before_training(root, monkeypatch, closed):
    mkdir = Path.mkdir

    def refuse(path: Path, mode: int = 0o777, parents: bool = False, exist_ok: bool = False) -> None:
        if path.name.endswith(".partial") and path.is_relative_to(root / closed):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))  # chmod would not stop the superuser
        mkdir(path, mode, parents, exist_ok)

    monkeypatch.setattr(Path, "mkdir", refuse)
    train_with(monkeypatch, Idle())
    with pytest.raises(UserError, match="Permission denied; choose a folder you may write to"):
        train_model(TINY, root, progress=False)


def test_rollouts_that_cannot_be_written_are_refused_before_the_clone_is_trained(root, monkeypatch):
    (root / "data/rollouts.h5").mkdir()
    train_with(monkeypatch, Idle())
    with pytest.raises(UserError, match=r"rollouts\.h5: a folder of that name stands there"):
        generate_rollouts(TINY, root, progress=False)


# damaged checkpoints


def torn(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def never_written(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def another_file(path: Path) -> None:
    path.write_bytes(b"{}" * 100)


DAMAGES = [(name, damage) for damage in (torn, empty, never_written, another_file) for name in ("last", "best")]


@pytest.mark.parametrize(("name", "damage"), [*DAMAGES, ("best", Path.unlink)])
def test_a_damaged_checkpoint_is_set_aside_and_training_starts_anew(root, monkeypatch, capsys, name, damage):
    expected = train_both(root)
    with monkeypatch.context() as patch:
        kill_in_epoch(patch, 2)
        with pytest.raises(Killed):
            train_both(root)
    (run,) = (root / ".envtf/runs").iterdir()
    damage(run / f"{name}.ckpt")
    capsys.readouterr()
    with monkeypatch.context() as patch:
        kill_in_epoch(patch, 0)
        with pytest.raises(Killed):
            train_both(root)
    aside = {"last.ckpt.unreadable", "best.ckpt.unreadable"} - (
        {"best.ckpt.unreadable"} if damage is Path.unlink else set()
    )
    assert {path.name for path in run.iterdir()} == aside
    assert train_both(root) == expected and not run.exists()
    (sentence,) = capsys.readouterr().err.strip().splitlines()
    assert f"{name}.ckpt is damaged or missing" in sentence and "training starts anew" in sentence


def test_a_kill_while_a_checkpoint_is_written_leaves_the_one_before(root, monkeypatch):
    expected = train_both(root)
    synced: list[int] = []

    def sync(file: int) -> None:
        synced.append(file)
        if len(synced) == 4:  # best and last of the first epoch, best of the second
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr("envtf_lit.training.os.fsync", sync)
        with pytest.raises(Killed):
            train_both(root)
    (run,) = (root / ".envtf/runs").iterdir()
    assert torch.load(run / "last.ckpt", weights_only=True)["epoch"] == 0
    (run / ".last.ckpt.0123abcd.partial").write_bytes(b"what a killed process leaves")
    with monkeypatch.context() as patch:
        patch.setattr("envtf_lit.world_models.fit.replacing", killed)
        with pytest.raises(Killed):
            train_both(root)
    assert {path.name for path in run.iterdir()} == {"best.ckpt", "last.ckpt"}
    assert train_both(root) == expected


def test_a_full_disk_leaves_the_checkpoint_before_and_a_sentence(tmp_path, monkeypatch):
    path = tmp_path / "last.ckpt"
    WholeCheckpoints().save_checkpoint({"epoch": 0}, str(path))

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("envtf_lit.training.os.fsync", full)
    with pytest.raises(UserError, match=r"No space left while writing .*last\.ckpt"):
        WholeCheckpoints().save_checkpoint({"epoch": 1}, str(path))
    assert torch.load(path, weights_only=True) == {"epoch": 0} and list(tmp_path.iterdir()) == [path]
