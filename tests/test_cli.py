"""`envtf`: help, exit codes, one readable sentence, and the stages and Lightning's command lines behind it."""

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import pytest

from envtf_lit.cli.main import LIGHTNING, STAGES, flags_to_overrides, main
from envtf_lit.data.sources.files import load_dataset
from envtf_lit.errors import UserError
from envtf_lit.pipeline.stage import ALGORITHMS
from envtf_lit.pipeline.yaml import dump_params, load_params, params_yaml, preset_params
from envtf_lit.robots.tasks import ROBOTS
from envtf_lit.zoo.train import RECIPES

COMMANDS = [*STAGES, "init", "params", "doctor"]


def exit_status(arguments: list[str]) -> int:
    """What `envtf` would leave to the shell."""
    try:
        main(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


@pytest.fixture(scope="module")
def tiny_download(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project in which `envtf download` has run."""
    folder = tmp_path_factory.mktemp("project")
    (folder / "params.yaml").write_text(params_yaml(preset_params("tiny")))
    command = [sys.executable, "-m", "envtf_lit", "download", "--quiet", "--download.transitions", "1000"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return folder


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status([command, "--help"]) == 0
    text = capsys.readouterr().out
    for section in STAGES.get(command, ("", []))[1]:
        options = re.findall(rf"--{re.escape(section)}\.[\w.]+ +\(.+, default .+\)\n {{8}}\S", text)
        assert len(options) >= 3, text


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(["--help"]) == 0
    text = capsys.readouterr().out
    assert [command for command in [*COMMANDS, *LIGHTNING, "data", "zoo"] if f"\n    {command}" not in text] == []


@pytest.mark.parametrize(
    ("arguments", "known"),
    [
        (["train_policy", "?"], ALGORITHMS),
        (["zoo", "train", "--robot", "?"], ROBOTS),
        (["zoo", "train", "--algorithm", "?"], RECIPES),
        (["hidden", "--robots", "?"], ROBOTS),
        (["horizon", "--robots", "?"], ROBOTS),
    ],
)
def test_names_that_the_command_line_writes_out_itself_are_all_there_are(
    arguments: list[str], known: Iterable[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """It would take a second to import what knows them."""
    assert exit_status(arguments) == 2
    named = capsys.readouterr().err.partition("choose from")[2]
    assert sorted(re.findall(r"\w+", named)) == sorted(known)


def test_help_is_quick() -> None:
    code = "import sys; from envtf_lit.cli import build_parser; build_parser(); assert 'torch' not in sys.modules"
    begin = time.perf_counter()
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    assert time.perf_counter() - begin < 10.0  # 0.1 s on an idle machine


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["download", "--sed", "1"], "did you mean 'seed'?"),
        (["download", "--seed"], "--seed needs a value"),
        (["download", "seed=1"], "is not an option"),
        (["download", "--params", "nowhere.yaml"], "nowhere.yaml does not exist"),
        (["download", "--download.source=file", "--download.path=nowhere.h5"], "nowhere.h5"),
        (["download", "--task", "hoper-medium-replay"], "did you mean 'hopper-medium-replay'?"),
        (["train_model"], "data/dataset.h5"),
        (["generate_rollouts"], "data/dataset.h5"),
        (["train_policy", "cql"], "data/dataset.h5"),
        (["evaluate"], "data/dataset.h5"),
        (["params", "--preset", "smal"], "did you mean 'small'?"),
        (["data", "convert", "nowhere.h5", "out.npz"], "nowhere.h5 is not a file"),
        (["data", "convert", "nowhere.h5", "out.csv"], "name a dataset .h5, .hdf5 or .npz"),
        (["data", "check", "nowhere.h5", "--task", "hoper-medium"], "did you mean 'hopper-medium'?"),
        (["init", "here", "--preset", "smal"], "did you mean 'small'?"),
    ],
)
def test_bad_input_ends_in_one_sentence(
    arguments: list[str], sentence: str, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_status(arguments) == 2
    errors = capsys.readouterr().err.strip().splitlines()
    assert sentence in errors[-1]
    assert not any(line.startswith("Traceback") for line in errors)
    assert [path.name for path in project.iterdir() if path.name not in ("params.yaml", ".envtf")] == []


def test_unknown_commands_and_arguments_are_usage_errors(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(["downlod"]) == 2
    assert exit_status(["doctor", "--fast"]) == 2
    assert exit_status([]) == 2
    assert "usage: envtf" in capsys.readouterr().err


def test_an_interrupt_says_how_to_go_on(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(arguments: list[str]) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("envtf_lit.cli.main._run", interrupted)
    assert exit_status(["train_model"]) == 130
    assert "continues" in capsys.readouterr().err


def test_flags_become_overrides() -> None:
    assert flags_to_overrides(["--seed", "1", "--a.b=c=d", "--x", "-3"]) == ["seed=1", "a.b=c=d", "x=-3"]
    with pytest.raises(UserError, match="needs a value"):
        flags_to_overrides(["--seed"])


def test_params_prints_what_init_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(["params", "--preset", "tiny"]) == 0
    printed = capsys.readouterr().out
    assert exit_status(["init", str(tmp_path / "new"), "--preset", "tiny"]) == 0
    assert (tmp_path / "new" / "params.yaml").read_text() == printed
    assert dump_params(load_params(tmp_path / "new" / "params.yaml")) == dump_params(preset_params("tiny"))


def test_init_leaves_an_existing_project_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "dvc.yaml").write_text("mine")
    assert exit_status(["init", str(tmp_path)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["dvc.yaml"]
    assert (tmp_path / "dvc.yaml").read_text() == "mine"


def everything(folder: Path) -> dict[str, bytes | None]:
    """Every file's bytes below a folder, but git's; None of a folder."""
    paths = [path for path in folder.rglob("*") if ".git" not in path.relative_to(folder).parts]
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in paths}


def test_init_in_a_repository_of_ones_own_changes_nothing_that_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    subprocess.run(["git", "init", "-q"], check=True)
    mine = ("notebooks/thesis.ipynb", "notebooks/figures/a.png", ".gitignore", ".dvcignore", ".dvc/config", "notes.md")
    for name in mine:
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(f"my {name}")
    before = everything(tmp_path)
    assert exit_status(["init", ".", "--preset", "tiny"]) == 0
    assert "Left as they were: .dvcignore, .gitignore, .dvc/config\n" in capsys.readouterr().out
    after = everything(tmp_path)
    assert {name: after[name] for name in before} == before
    new = {"dvc.yaml", "params.yaml", "notebooks/report.ipynb", ".dvc/.gitignore"}
    assert after.keys() - before.keys() == new


@pytest.mark.parametrize("name", ["params.yaml", "notebooks/report.ipynb", "notebooks", ".dvc", ".gitignore/deep"])
def test_init_names_what_stands_in_its_way_and_writes_nothing(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text("mine")
    before = everything(tmp_path)
    assert exit_status(["init", str(tmp_path)]) == 2
    assert f"({name.removesuffix('/deep')})" in capsys.readouterr().err
    assert everything(tmp_path) == before


def test_an_init_that_was_interrupted_is_finished_by_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("envtf_lit.project.template._write_pipeline", interrupt)
        assert exit_status(["init", str(tmp_path)]) == 130
    assert exit_status(["init", str(tmp_path)]) == 0
    assert (tmp_path / "dvc.yaml").is_file()


def test_git_that_comes_after_init_needs_nothing_but_what_dvc_advises(tmp_path: Path) -> None:
    assert exit_status(["init", str(tmp_path), "--preset", "tiny"]) == 0
    status = [sys.executable, "-m", "dvc", "status", "--quiet"]
    assert subprocess.run(status, cwd=tmp_path, capture_output=True, check=False).returncode in (0, 1)
    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    subprocess.run([*status[:3], "config", "core.no_scm", "false"], cwd=tmp_path, check=True)
    shown = subprocess.run([*status[:3], "exp", "list"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "Only supported for Git repositories" not in shown.stderr


def test_doctor_reports_what_a_bug_report_needs(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(["doctor"]) == 0
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert {"python", "torch", "mujoco", "cores", "device", "memory", "disk", "rendering"} <= lines.keys()
    assert "missing" not in lines.values()


def test_a_stage_writes_its_outputs_and_prints_its_metrics(tiny_download: Path) -> None:
    dataset = load_dataset(tiny_download / "data" / "dataset.h5")
    assert len(dataset) == 1000
    assert json.loads((tiny_download / "data" / "dataset.json").read_text())["transitions"] == 1000


def test_download_does_not_write_over_the_file_that_it_reads(
    tiny_download: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tiny_download)
    before = everything(tiny_download / "data")
    assert exit_status(["download", "--download.source=file", "--download.path=./data/dataset.h5"]) == 2
    assert "move your file to another place" in capsys.readouterr().err
    assert everything(tiny_download / "data") == before


@pytest.mark.parametrize("kind", LIGHTNING)
def test_lightnings_help_says_that_a_config_is_trusted(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status([kind, "--help"]) == 0
    assert "trusted like code" in " ".join(capsys.readouterr().out.split())


def test_lightnings_command_lines_refuse_bad_input_alike(project: Path) -> None:
    output = run(project, "model", "fit", "--data.path", "nowhere.h5", expected=2)
    assert "envtf: nowhere.h5" in output.splitlines()[-1]
    assert "Traceback" not in output


FULL_DISK = """
import resource, sys
from envtf_lit.cli.lightning import run
from envtf_lit.cli import main

resource.setrlimit(resource.RLIMIT_FSIZE, (4_000, 4_000))  # every larger file fails as on a full disk
main(sys.argv[1:])
"""


def test_a_disk_that_is_full_of_checkpoints_is_said_in_a_sentence(tiny_download: Path, tmp_path: Path) -> None:
    pytest.importorskip("resource")
    sizes = {"model.layers": 1, "model.width": 16, "model.context": 4, "updates_per_epoch": 2, "updates": 2}
    options = [f"--model.options.{key}={value}" for key, value in sizes.items()]
    fit = ["model", "fit", "--data.path", str(tiny_download / "data/dataset.h5"), "--trainer.logger=false", *options]
    output = run(tmp_path, *fit, program=["-c", FULL_DISK], expected=2)
    assert output.splitlines()[-1].startswith("envtf: No space left on the disk")
    assert not list(tmp_path.rglob("*.ckpt")) and not list(tmp_path.rglob("published"))


def test_a_rendering_back_end_that_is_not_there_stops_neither_stage_nor_doctor(project: Path) -> None:
    run(project, "download", "--quiet", "--download.transitions=1000", MUJOCO_GL="osmesa")
    assert (project / "data/dataset.h5").exists()
    report = run(project, "doctor", MUJOCO_GL="glut")  # none of MuJoCo's: nowhere installed
    assert "MUJOCO_GL        glut" in report and "rendering " in report


def run(
    folder: Path, *arguments: str, expected: int = 0, program: Sequence[str] = ("-m", "envtf_lit"), **variables: str
) -> str:
    """Runs `envtf` in a process of its own and returns all that it printed."""
    result = subprocess.run(
        [sys.executable, *program, *arguments],
        cwd=folder,
        env=os.environ | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert result.returncode == expected, result.stdout
    return result.stdout
