"""`envtf`: help, exit codes, one readable sentence, and the stages and Lightning's command lines behind it."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path

import pytest

from envtf_lit.cli.command import parse_words
from envtf_lit.cli.commands import COMMANDS, GROUPS
from envtf_lit.cli.main import main
from envtf_lit.cli.stages import STAGES, StageParser, split
from envtf_lit.data.sources.files import load_dataset
from envtf_lit.errors import UserError
from envtf_lit.pipeline.yaml import dump_params, load_params, params_yaml, preset_params
from envtf_lit.robots.tasks import ROBOTS
from envtf_lit.zoo.train import RECIPES
from tests.test_docs import PAGES, ROOT

LIGHTNING = [name for name, command in COMMANDS.items() if command.module == "lightning"]
OURS = [name for name in COMMANDS if name not in LIGHTNING]


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


@pytest.mark.parametrize("command", OURS)
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status([*command.split(), "--help"]) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: envtf {command} [-h]")
    assert COMMANDS[command].summary in " ".join(text.split())
    for section in STAGES[command].sections if command in STAGES else ():
        options = re.findall(rf"--{re.escape(section)}\.[\w.]+ +\(.+, default .+\)\n {{8}}\S", text)
        assert len(options) >= 3, text


def test_every_flag_is_explained(capsys: pytest.CaptureFixture[str]) -> None:
    for command in OURS:
        exit_status([*command.split(), "--help"])
        listed = capsys.readouterr().out.partition("options:")[2].partition("options of params.yaml")[0]
        flags = re.findall(r"^  (--\S+)(.*(?:\n {4,}.*)*)", listed, re.MULTILINE)
        assert [flag for flag, text in flags if len(text.split()) < 2] == [], listed


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(["--help"]) == 0
    text = capsys.readouterr().out
    first = dict.fromkeys(name.split()[0] for name in COMMANDS)
    assert [command for command in first if f"\n    {command}" not in text] == []
    for group in GROUPS:
        assert exit_status([group, "--help"]) == 0
        text = capsys.readouterr().out
        verbs = [name.split()[1] for name in COMMANDS if name.startswith(f"{group} ")]
        assert verbs and [verb for verb in verbs if f"\n    {verb}" not in text] == []


def documented() -> list[str]:
    """What README and docs call `envtf` with: lines of code blocks, and code within sentences."""
    found = list[str]()
    for page in PAGES:
        text = page.read_text()
        found += re.findall(r"^ *envtf (.+)$", text, re.MULTILINE) + re.findall(r"`envtf ([^`\n]+)`", text)
    return sorted(dict.fromkeys(found))


def test_every_command_in_the_documentation_is_understood() -> None:
    lines = documented()
    assert len(lines) > 40
    for line in lines:
        words = shlex.split(line, comments=True)
        if words[0].startswith("-"):
            continue
        name = " ".join(words[:2]) if words[0] in GROUPS else words[0]
        assert name in COMMANDS, line
        rest = words[len(name.split()) :]
        if name in LIGHTNING:
            cli = import_module("envtf_lit.cli.lightning").CLASSES[name][0]
            assert not rest or rest[0] in (*cli.verbs, "--help"), line
        elif name in STAGES:
            own, overrides = split(rest)
            StageParser(name).parse_args(own or ["cql"] * bool(STAGES[name].takes))
            load_params(ROOT / "params.yaml", overrides)
        elif rest and "--help" not in rest:
            rest += ["--out", "x"] * (name in ("hidden", "horizon", "calibrate") and "--out" not in rest)
            parse_words(import_module(f"envtf_lit.cli.{COMMANDS[name].module}").FUNCTIONS[name], name, rest)


@pytest.mark.parametrize(
    ("arguments", "known"),
    [
        (["calibrate", "--robots", "hopper", "?"], ROBOTS),
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


@pytest.mark.parametrize(
    ("arguments", "absent"),
    [
        (["--help"], ["torch", "lightning", "jsonargparse", "numpy", "rich"]),
        (["train_model", "--help"], ["torch", "lightning", "jsonargparse", "numpy"]),
        *(([*command.split(), "--help"], ["torch", "lightning", "numpy"]) for command in ("horizon", "zoo build")),
    ],
)
def test_help_imports_nothing_slow(arguments: list[str], absent: list[str]) -> None:
    code = (
        "import atexit, sys\n"
        f"atexit.register(lambda: print('late:', [name for name in {absent} if name in sys.modules]))\n"
        "from envtf_lit.cli.main import main\n"
        f"main({arguments})"
    )
    begin = time.perf_counter()
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.splitlines()[-1] == "late: []"
    assert time.perf_counter() - begin < 10.0  # 0.2 s on an idle machine


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
        (["train_policy", "etcql"], "Unknown algorithm 'etcql': did you mean 'et_cql'?"),
        (["train_policy"], "required: ALGORITHM (see `envtf train_policy --help`)"),
        (["train_policy", "cql", "et_cql"], "'et_cql' is not an option"),
        (["trian_model"], "did you mean 'train_model'?"),
        (["data", "chekc"], "did you mean 'check'?"),
        (["horizon", "--out", "x", "--robot", "hopper"], "did you mean '--robots'?"),
        (["horizon"], "--out is missing"),
        (["horizon", "--out", "x", "--robots", "hopper", "hoper"], "--robots 'hoper' is unknown: did you mean"),
        (["horizon", "--out", "x", "--windows=0"], "--windows '0' is out of range: give a whole number above 0."),
        (["bench", "model", "--rounds", "1.5"], "--rounds '1.5' is out of range: give a whole number above 0."),
        (["zoo", "settle", "--robot", "ant", "--out", "x", "--noise", "inf"], "give a finite number"),
        (["zoo", "build", "--full", "--transitions", "3"], "two sizes"),
        (["zoo", "build", "--transitions", "many"], "--transitions 'many' is out of range: give a whole number."),
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


@pytest.mark.parametrize(
    ("arguments", "rerun"),
    [
        (["train_model"], "continues training from the last finished epoch"),
        (["zoo", "build"], "keeps the datasets that are whole"),
        (["evaluate"], "begins anew"),
    ],
)
def test_an_interrupt_says_how_to_go_on(
    arguments: list[str], rerun: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(arguments: list[str]) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("envtf_lit.cli.main._run", interrupted)
    assert exit_status(arguments) == 130
    assert rerun in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_a_training_with_a_sentence(
    number: int, tiny_download: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Lightning, which has handlers of its own, ends such a run with status 1 or 0."""
    monkeypatch.chdir(tiny_download)
    monkeypatch.setattr(
        "lightning.pytorch.callbacks.Callback.on_train_batch_end", lambda *_: signal.raise_signal(number)
    )
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    assert exit_status(["train_model", "--quiet"]) == 128 + number
    assert capsys.readouterr().err.splitlines()[-1].startswith("envtf: Interrupted. The same command continues")
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


WAITING = """
import concurrent.futures, multiprocessing, sys, time
from envtf_lit.cli import main, project

def doctor():
    with concurrent.futures.ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        waiting = pool.submit(time.sleep, 60)
        while not waiting.running():
            time.sleep(0.01)
        print("ready", flush=True)
        waiting.result()

if __name__ == "__main__":
    project.FUNCTIONS["doctor"] = doctor
    doctor.__doc__ = "Waits."
    main.main(["doctor"])
"""


def test_a_pool_does_not_hold_up_a_termination(tmp_path: Path) -> None:
    (tmp_path / "waiting.py").write_text(WAITING)
    process = subprocess.Popen(
        [sys.executable, "waiting.py"], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    process.terminate()
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 143
    assert "envtf: Interrupted. The same command begins anew." in errors.splitlines()


def test_flags_become_overrides() -> None:
    assert split(["--seed", "1", "--a.b=c=d", "--x", "-3"]) == ([], ["seed=1", "a.b=c=d", "x=-3"])
    assert split(["cql", "--seed", "1", "--params", "p.yaml", "--quiet"])[0] == ["cql", "--params", "p.yaml", "--quiet"]
    assert split(["--seed", "1", "cql"]) == (["cql"], ["seed=1"])
    for words in (["--seed"], ["--seed", "--quiet"]):
        with pytest.raises(UserError, match="--seed needs a value"):
            split(words)


def test_words_of_a_command_line_become_arguments_of_a_function() -> None:
    functions = import_module("envtf_lit.cli.studies").FUNCTIONS
    words = ["--out", "a #b.json", "--robots", "hopper", "ant", "--model", "a=b=c", "--model", "d=[e]", "--seed=3"]
    _, named = parse_words(functions["horizon"], "horizon", [*words, "--ensemble-updates", "7", "--quiet"])
    assert (named["out"], named["robots"], named["model"]) == (Path("a #b.json"), ("hopper", "ant"), ("a=b=c", "d=[e]"))
    training = named["training"]
    assert (training.seed, training.ensemble_updates, training.quiet, training.context) == (3, 7, True, 16)
    assert parse_words(functions["hidden"], "hidden", ["--out", "x"])[1]["training"].context == 32
    _, named = parse_words(functions["bench model"], "bench model", ["--out", "null"])
    assert (named["out"], named["device"], named["windows"]) == (Path("null"), None, None)


def test_no_value_names_code_and_neither_files_nor_environment_set_any(
    project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """jsonargparse's other ways in, which a command line that others' scripts call must not have."""
    monkeypatch.setenv("JSONARGPARSE_DEFAULT_ENV", "true")
    monkeypatch.setenv("ENVTF_HORIZON__OUT", "x")
    assert exit_status(["horizon"]) == 2
    assert "--out is missing" in capsys.readouterr().err
    (project / "x.yaml").write_text("out: x.json")
    for flag in ("--config", "--print_config", "--print_completion"):
        assert exit_status(["horizon", "--out", "x", flag, "x.yaml"]) == 2
        assert "is not an option" in capsys.readouterr().err
    function = import_module("envtf_lit.cli.data").FUNCTIONS["data check"]
    text = '{"class_path": "subprocess.Popen", "init_args": {"args": "ls"}}'
    assert parse_words(function, "data check", [text, "--task", text]) == ([text], {"task": text})


def test_brackets_in_a_path_are_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "a[bold]b :cat: [/]"
    assert exit_status(["init", str(folder), "--preset", "tiny"]) == 0
    assert f"Wrote a project to {folder}. Next" in capsys.readouterr().out
    assert exit_status(["data", "check", str(folder / "[red]my.h5")]) == 2
    assert str(folder / "[red]my.h5") in capsys.readouterr().out
    assert exit_status(["data", "convert", str(folder / "[red]my.h5"), "x.npz"]) == 2
    assert f"envtf: {folder / '[red]my.h5'} is not a file" in capsys.readouterr().err


def test_an_output_that_is_not_utf8_shows_stand_ins(tiny_download: Path) -> None:
    shown = run(tiny_download, "data", "check", "data/dataset.h5", PYTHONIOENCODING="ascii")
    assert "1,000 transitions" in shown and "?" in shown


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


def test_doctor_reports_what_a_bug_report_needs(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(["doctor"]) == 0
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert {"python", "torch", "mujoco", "cores", "device", "memory", "disk", "rendering"} <= lines.keys()
    assert "missing" not in lines.values()


def test_a_stage_writes_its_outputs_and_prints_its_metrics(tiny_download: Path) -> None:
    dataset = load_dataset(tiny_download / "data" / "dataset.h5")
    assert len(dataset) == 1000
    assert json.loads((tiny_download / "data" / "dataset.json").read_text())["transitions"] == 1000


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
from envtf_lit.cli.main import main

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
