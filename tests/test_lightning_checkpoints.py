"""`envtf model …` and `envtf agent …` with --ckpt_path: options, weights and bits come back; nothing else is taken."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from envtf_lit.data.sources.files import save_dataset
from envtf_lit.files import read_json, write_json
from tests.lightning_runs import NO_LOGGER, RUN, enter_project, envtf, fit, fit_ensemble, refused
from tests.walker import walker_dataset

# Lightning 2.6's use of an older jsonargparse's names
pytestmark = pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project with a dataset, and the current folder."""
    return enter_project(tmp_path, monkeypatch)


PLAIN = (dict, list, tuple, int, float, bool, str, type(None))


def all_types(tree: Any) -> set[type]:
    below = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list | tuple) else ()
    return {type(tree)}.union(*(all_types(item) for item in below))


@pytest.mark.parametrize("kind", ["transformer", "ensemble", "cql", "bc"])
def test_checkpoints_hold_options_as_plain_numbers(kind: str, folder: Path) -> None:
    if kind == "ensemble":
        fit_ensemble("--model.kind=ensemble")
    elif kind == "transformer":
        fit("model")
    else:
        fit("agent", f"--model.algorithm={kind}")
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    saved = torch.load(checkpoint, weights_only=False)["hyper_parameters"]
    assert all_types(saved) <= set(PLAIN) and saved["options"]["batch_size"] == 8


@pytest.mark.parametrize("kind", ["model", "agent"])
def test_a_continued_run_keeps_the_checkpoints_options_where_no_flag_differs(kind: str, folder: Path) -> None:
    fit(kind, "--model.seed=3")
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    longer_by_two = 2 * RUN[kind]["updates"]
    envtf(kind, "fit", NO_LOGGER, f"--ckpt_path={checkpoint}", updates=longer_by_two)
    (longer,) = set(Path(".envtf").rglob("*.ckpt")) - {checkpoint}
    before, after = (torch.load(path, weights_only=True) for path in (checkpoint, longer))
    assert (before["epoch"], after["epoch"]) == (1, 3)
    assert after["hyper_parameters"].pop("options") == before["hyper_parameters"].pop("options") | {
        "updates": longer_by_two
    }
    assert after["hyper_parameters"] == before["hyper_parameters"] and before["hyper_parameters"]["seed"] == 3


def written() -> dict[str, bytes]:
    """Name and bytes of every file that fit published."""
    files = (path for path in sorted(Path(".envtf/published").rglob("*")) if path.is_file())
    return {str(path): path.read_bytes() for path in files}


@pytest.mark.parametrize("kind", ["model", "agent"])
@pytest.mark.parametrize("tuned", [False, True])
def test_a_continued_run_equals_an_uninterrupted_one(kind: str, tuned: bool, folder: Path) -> None:
    flags, options = [], {}
    if tuned:
        fit(kind)
        shutil.move(".envtf/published", "base")
        shutil.rmtree(".envtf")
        save_dataset(walker_dataset(seed=1), "data/dataset.h5")
        part = {"model": "blocks", "agent": "net.0"}[kind]
        flags = ["--model.init_from=base", f"--model.freeze=[{part}]"]
        options = {"agent": {"warm_start": 0.75}, "model": {}}[kind]  # the kill is in the warm-up
    fit(kind, "--trainer.max_epochs=1", *flags, **options)
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    if tuned:
        Path("base").rename("elsewhere")  # a continued run needs it no more
    envtf(kind, "fit", NO_LOGGER, f"--ckpt_path={checkpoint}")
    resumed = written()
    if tuned:
        Path("elsewhere").rename("base")
    fit(kind, *flags, **options)
    assert written() == resumed


def test_model_test_takes_other_episodes_than_validate_and_no_options_beside_the_checkpoint(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    split = "--data.held_out=0.4"
    fit("model", split)
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    numbers = {}
    for verb, prefix in (("validate", "val"), ("test", "test")):
        capsys.readouterr()
        envtf("model", verb, NO_LOGGER, f"--ckpt_path={checkpoint}", split)
        words = capsys.readouterr().out.replace("│", " ").split()
        numbers[verb] = [words[words.index(f"{prefix}/{name}") + 1] for name in ("loss", "open_loop_error")]
    assert float(numbers["validate"][0]) > 0 and float(numbers["test"][0]) > 0
    assert numbers["validate"] != numbers["test"]


def test_checkpoints_that_do_not_fit_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fit("model")
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    assert "does not exist" in refused(capsys, "model", "fit", "--ckpt_path=nowhere.ckpt")
    assert "not a checkpoint" in refused(capsys, "model", "fit", "--ckpt_path=data/dataset.h5")
    changed = refused(capsys, "model", "fit", NO_LOGGER, f"--ckpt_path={checkpoint}", width=8)
    assert "does not fit the model" in changed and "change the architecture" in changed
    assert "not a checkpoint" in refused(capsys, "agent", "fit", NO_LOGGER, f"--ckpt_path={checkpoint}")
    saved = torch.load(checkpoint, weights_only=True)
    options = saved["hyper_parameters"]["options"]  # nested, as they once were
    saved["hyper_parameters"]["options"] = {"model": options, "ensemble": None, "held_out": 0.1, "updates": 4}
    torch.save(saved, "older.ckpt")
    older = refused(capsys, "model", "fit", NO_LOGGER, "--ckpt_path=older.ckpt")
    assert "older.ckpt is not a checkpoint of this model (Unknown option 'model' in options" in older


def test_folders_of_an_older_layout_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fit("model")
    Path("models").mkdir()
    Path(".envtf/published").rename("models/world_model")
    config = read_json("models/world_model/config.json")
    config["arguments"]["memory"] = 4
    write_json("models/world_model/config.json", config)
    sentence = refused(capsys, "model", "fit", NO_LOGGER, "--model.init_from=models/world_model")
    assert "models/world_model/config.json: Unknown option 'memory' in arguments" in sentence
