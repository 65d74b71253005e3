"""`envtf`: help, exit codes, one readable sentence, and the stages and Lightning's command lines behind it."""

import os
import re
import subprocess
import sys
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path

import pytest

from envtf_lit.cli.commands import COMMANDS, GROUPS
from envtf_lit.cli.main import main
from envtf_lit.cli.signatures import parse_words
from envtf_lit.cli.stages import STAGES, split
from envtf_lit.errors import UserError
from envtf_lit.robots.tasks import ROBOTS
from envtf_lit.zoo.train import RECIPES

LIGHTNING = [name for name, command in COMMANDS.items() if command.module == "lightning"]
OURS = [name for name in COMMANDS if name not in LIGHTNING]


def exit_status(arguments: list[str]) -> int:
    """What `envtf` would leave to the shell."""
    try:
        main(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


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
        (["zoo", "--help"], ["torch", "lightning", "jsonargparse", "numpy", "rich"]),
        *(
            ([*command.split(), "--help"], ["torch", "lightning", "numpy"])
            for command in ("horizon", "zoo build", "train_model", "evaluate")
        ),
    ],
)
def test_help_imports_nothing_slow(arguments: list[str], absent: list[str]) -> None:
    code = (
        "import atexit, sys\n"
        f"atexit.register(lambda: print('late:', [name for name in {absent} if name in sys.modules]))\n"
        "from envtf_lit.cli.main import main\n"
        f"main({arguments})"
    )
    begin = os.times().children_user
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.splitlines()[-1] == "late: []"
    assert os.times().children_user - begin < 5.0  # seconds of a processor: 0.2 on an idle machine


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["download", "--sed", "1"], "did you mean 'seed'?"),
        (["download", "--seed"], "--seed needs a value"),
        (["download", "seed=1"], "is not an option"),
        (["download", "--params", "nowhere.yaml"], "nowhere.yaml does not exist"),
        (["download", "--download.source=file", "--download.path=nowhere.h5"], "nowhere.h5"),
        (["download", "--task", "hoper-medium-replay"], "did you mean 'hopper-medium-replay'?"),
        (["source", "--download.source=file", "--download.path=nowhere.h5"], "nowhere.h5, which is not a file"),
        (["train_model"], "data/dataset.h5"),
        (["train_model", "transfomer"], "no section 'transfomer' below train_model: did you mean 'transformer'?"),
        (["train_model", "--train_model.updates", "9000"], "it is train_model.transformer.updates now"),
        (["generate_rollouts"], "data/dataset.h5"),
        (["generate_rollouts", "none"], "no section 'none' below train_model"),
        (["train_policy", "cql"], "data/dataset.h5"),
        (["train_policy", "etcql"], "no section 'etcql' below train_policy: did you mean 'et_cql'?"),
        (["train_policy"], "train_policy has the sections bc, cql, et_cql: name one of them."),
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


@pytest.mark.parametrize("command", [["data", "check"], ["data", "convert"], ["download", "--params"], ["init"]])
@pytest.mark.parametrize("place", ["long", "circle"])
def test_a_path_that_can_be_no_file_ends_in_a_sentence(
    command: list[str], place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / ("x" * 300 + ".h5" if place == "long" else "circle.h5")
    if place == "circle":
        path.symlink_to(path)
    rest = [str(tmp_path / "out.h5")] if command[-1] == "convert" else []
    assert exit_status([*command, str(path), *rest]) != 0
    said = capsys.readouterr()
    assert "Traceback" not in said.err and (said.err + said.out).strip()
