"""From the last update to the published folder: no training is lost there, nor for a checkpoint that is damaged."""

import errno
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from envtf_lit.data.sources.files import save_dataset
from envtf_lit.errors import UserError
from envtf_lit.pipeline.generate_rollouts import generate_rollouts
from envtf_lit.pipeline.train_model import train_model
from envtf_lit.pipeline.train_policy import train_policy
from envtf_lit.training import WholeCheckpoints, trained
from envtf_lit.world_models.lit import lit_world_model, window_data
from envtf_lit.world_models.options import EnsembleOptions
from tests.test_training import (
    LOG,
    MODEL,
    TINY,
    Idle,
    Killed,
    bytes_of,
    kill_in_epoch,
    killed,
    killed_run,
    train_whole,
    train_with,
)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    save_dataset(LOG, tmp_path / "data/dataset.h5")
    return tmp_path


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What a training that nothing disturbs publishes, wherever its project lies."""
    folder = tmp_path_factory.mktemp("whole")
    save_dataset(LOG, folder / "data/dataset.h5")
    return train_whole(folder)


@pytest.fixture(scope="module")
def killed_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project whose training was killed in its third epoch."""
    folder = tmp_path_factory.mktemp("killed")
    save_dataset(LOG, folder / "data/dataset.h5")
    with pytest.MonkeyPatch.context() as patch:
        killed_run(folder, patch)
    return folder


@pytest.fixture
def run(killed_once: Path, tmp_path: Path) -> Path:
    """The killed run in a copy of that project, which is `tmp_path`."""
    shutil.copytree(killed_once, tmp_path, dirs_exist_ok=True)
    (found,) = (tmp_path / ".envtf/runs").iterdir()
    return found


ENSEMBLE = EnsembleOptions(
    members=3, elites=2, hidden=(8,), weight_decay=(0.0, 0.0), updates=40, updates_per_epoch=4, patience=1
)
ENSEMBLES = replace(TINY, train_model={"ensemble": ENSEMBLE})
# stage, parameters, section, what it writes, the files it keeps until that is done, and where it is killed
GAPS = {
    "model": ("model", TINY, "transformer", {"best.ckpt", "last.ckpt"}, "world_models.fit.replacing"),
    "ensemble": ("model", ENSEMBLES, "ensemble", {"last.ckpt"}, "world_models.fit.replacing"),
    "uncertainty": (
        "model",
        TINY,
        "transformer",
        {"best.ckpt", "last.ckpt"},
        "world_models.lit.LitWorldModel.fit_uncertainty",
    ),
    "clone": ("policy", TINY, "bc", {"last.ckpt"}, "agents.store.replacing"),
    "policy": ("policy", TINY, "et_cql", {"last.ckpt"}, "agents.store.replacing"),
}


@pytest.mark.parametrize("gap", GAPS)
def test_a_kill_between_training_and_publication_loses_no_training(root, monkeypatch, gap):
    kind, params, name, kept, place = GAPS[gap]
    if name == "et_cql":
        train_model(TINY, root, progress=False)
        train_policy(TINY, root, name="bc", progress=False)
        generate_rollouts(TINY, root, progress=False)
    stage, target = (
        (train_model, f"models/world_model/{name}") if kind == "model" else (train_policy, f"models/policy/{name}")
    )
    metrics = stage(params, root, name=name, progress=False)
    expected = bytes_of(root / target)
    assert list((root / ".envtf/runs").iterdir()) == []
    with monkeypatch.context() as patch:
        patch.setattr(f"envtf_lit.{place}", killed)
        with pytest.raises(Killed):
            stage(params, root, name=name, progress=False)
    (run,) = (root / ".envtf/runs").iterdir()
    assert {path.name for path in run.iterdir()} == kept
    with monkeypatch.context() as patch:
        train_with(patch, Idle())
        assert stage(params, root, name=name, progress=False) == metrics
    assert bytes_of(root / target) == expected and not run.exists()


def test_what_was_trained_is_there_until_the_block_that_publishes_has_succeeded(root, monkeypatch):
    data = window_data(str(root / "data/dataset.h5"), MODEL, seed=0)

    def train(seed: int) -> Any:
        lit = lit_world_model(data.observation_dim, data.action_dim, MODEL, seed=seed)
        options: dict[str, Any] = dict(epochs=3, precision="fp32", progress=False, monitor=lit.monitor)
        return lit, trained(lit, data, run=root / "run", target=root / "there", **options)

    lit, training = train(0)
    with pytest.raises(Killed), training as curves:
        raise Killed
    assert (root / "run/last.ckpt").exists() and not (root / "there").exists()
    train_with(monkeypatch, Idle())
    other, training = train(1)
    with training as again:
        assert again.rows == curves.rows and len(curves.rows) == 3
    assert all(torch.equal(a, b) for a, b in zip(lit.parameters(), other.parameters(), strict=True))
    assert not (root / "run").exists()


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
@pytest.mark.parametrize("target", ["models/world_model/transformer", "models/policy/cql"])
def test_a_target_that_cannot_be_written_is_refused_before_training(root, monkeypatch, obstacle, target):
    (root / target).parent.mkdir(parents=True)
    said = obstacle(root / target)
    train_with(monkeypatch, Idle())
    train = {
        "models/world_model/transformer": lambda: train_model(TINY, root, progress=False),
        "models/policy/cql": lambda: train_policy(TINY, root, name="cql", progress=False),
    }[target]
    with pytest.raises(UserError, match=said):
        train()
    assert not (root / ".envtf/runs").exists()


@pytest.mark.parametrize(("closed", "method"), [("models", "mkdir"), (".envtf/runs", "touch")])
def test_a_read_only_folder_is_refused_before_training(root, monkeypatch, closed, method):
    create = getattr(Path, method)

    def refuse(path: Path, *arguments: Any, **options: Any) -> None:  # chmod would not stop the superuser
        if path.name.endswith(".partial") and path.is_relative_to(root / closed):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        create(path, *arguments, **options)

    monkeypatch.setattr(Path, method, refuse)
    train_with(monkeypatch, Idle())
    with pytest.raises(UserError, match="Permission denied; choose a folder you may write to"):
        train_model(TINY, root, progress=False)


def test_rollouts_that_cannot_be_written_are_refused_before_any_is_imagined(root, monkeypatch):
    train_model(TINY, root, progress=False)
    train_policy(TINY, root, name="bc", progress=False)
    (root / "data/rollouts/transformer.h5").mkdir(parents=True)
    monkeypatch.setattr("envtf_lit.pipeline.generate_rollouts.imagine", killed)
    with pytest.raises(UserError, match=r"transformer\.h5: a folder of that name stands there"):
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
def test_a_damaged_checkpoint_is_set_aside_and_training_starts_anew(
    run, tmp_path, expected, monkeypatch, capsys, name, damage
):
    damage(run / f"{name}.ckpt")
    capsys.readouterr()
    with monkeypatch.context() as patch:
        kill_in_epoch(patch, 0)
        with pytest.raises(Killed):
            train_whole(tmp_path)
    aside = {"last.ckpt.unreadable", "best.ckpt.unreadable"} - (
        {"best.ckpt.unreadable"} if damage is Path.unlink else set()
    )
    assert {path.name for path in run.iterdir()} == aside
    assert train_whole(tmp_path) == expected and not run.exists()
    (sentence,) = capsys.readouterr().err.strip().splitlines()
    assert f"{name}.ckpt is damaged or missing" in sentence and "training starts anew" in sentence


def test_a_checkpoint_of_another_version_is_set_aside(run, tmp_path, expected, capsys):
    saved = torch.load(run / "last.ckpt", weights_only=True)
    saved["state_dict"]["horizon"] = torch.zeros(3)
    torch.save(saved, run / "last.ckpt")
    capsys.readouterr()
    assert train_whole(tmp_path) == expected
    (sentence,) = capsys.readouterr().err.strip().splitlines()
    assert "last.ckpt holds other weights than this version trains" in sentence and "anew" in sentence


def test_a_kill_while_a_checkpoint_is_written_leaves_the_one_before(root, expected, monkeypatch):
    synced: list[int] = []

    def sync(file: int) -> None:
        synced.append(file)
        if len(synced) == 4:  # best and last of the first epoch, best of the second
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr("envtf_lit.files.os.fsync", sync)
        with pytest.raises(Killed):
            train_whole(root)
    (run,) = (root / ".envtf/runs").iterdir()
    assert torch.load(run / "last.ckpt", weights_only=True)["epoch"] == 0
    (run / ".last.ckpt.0123abcd.partial").write_bytes(b"what a killed process leaves")
    with monkeypatch.context() as patch:
        patch.setattr("envtf_lit.world_models.fit.replacing", killed)
        with pytest.raises(Killed):
            train_whole(root)
    assert {path.name for path in run.iterdir()} == {"best.ckpt", "last.ckpt"}
    assert train_whole(root) == expected


def test_a_full_disk_leaves_the_checkpoint_before_and_a_sentence(tmp_path, monkeypatch):
    path = tmp_path / "last.ckpt"
    WholeCheckpoints().save_checkpoint({"epoch": 0}, str(path))

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("envtf_lit.files.os.fsync", full)
    with pytest.raises(UserError, match=r"No space left while writing .*last\.ckpt"):
        WholeCheckpoints().save_checkpoint({"epoch": 1}, str(path))
    assert torch.load(path, weights_only=True) == {"epoch": 0} and list(tmp_path.iterdir()) == [path]
