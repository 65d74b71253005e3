"""`envtf model …` and `envtf agent …`: which kind is trained, with which options, and what is refused."""

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from envtf_lit import load_world_model
from envtf_lit.agents.cql import CQLOptions
from envtf_lit.cli.arguments import given, of_today
from envtf_lit.data.datamodules import TransitionData, WindowData
from envtf_lit.data.options import DownloadOptions
from envtf_lit.errors import UserError
from envtf_lit.world_models.ensemble import EnsembleDynamics
from tests.lightning_runs import (
    NO_LOGGER,
    RUN,
    SIZES,
    STILL,
    enter_project,
    envtf,
    fit,
    fit_ensemble,
    refused,
    same,
)

# Lightning 2.6's use of an older jsonargparse's names
pytestmark = pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project with a dataset, and the current folder."""
    return enter_project(tmp_path, monkeypatch)


@pytest.mark.parametrize("algorithm", ["combo", "et_cql", "et_cql_paper"])
def test_agents_that_imagine_are_refused(algorithm: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sentence = refused(capsys, "agent", "fit", NO_LOGGER, f"--model.algorithm={algorithm}")
    assert f"{algorithm} needs a world model" in sentence and "train_policy" in sentence
    assert "world_model is transformer" in refused(capsys, "agent", "fit", NO_LOGGER, world_model="transformer")


@pytest.mark.slow
def test_a_model_is_of_the_kind_of_what_it_starts_from(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fit_ensemble("--model.kind=ensemble")
    Path(".envtf/published").rename("first")
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    still = {"weight_decay": [0, 0], "learning_rate": STILL, "batch_size": 8}
    for number, word in enumerate(("--model.init_from=first", "--model.init_from first")):
        shutil.rmtree(".envtf/published", ignore_errors=True)
        envtf("model", "fit", NO_LOGGER, "--config=finetune", *word.split(), "--trainer.max_epochs=1", **still)
        first, second = load_world_model("first"), load_world_model(".envtf/published")
        assert isinstance(first, EnsembleDynamics) and isinstance(second, EnsembleDynamics)
        assert same(first.weights, second.weights), number
    Path("start.yaml").write_text("model: {init_from: first}")
    envtf("model", "fit", NO_LOGGER, "--config=start.yaml", "--trainer.max_epochs=1", **still)
    assert isinstance(load_world_model(".envtf/published"), EnsembleDynamics)
    for start in ("--model.init_from=first", f"--ckpt_path={checkpoint}"):
        for other in ("--model.kind=transformer", "--model.kind transformer"):
            sentence = refused(capsys, "model", "fit", NO_LOGGER, start, *other.split())
            assert "--model.kind is transformer" in sentence and "give --model.kind ensemble" in sentence
    assert "give --model.algorithm cql" in agent_of_another_algorithm(capsys)


def agent_of_another_algorithm(capsys: pytest.CaptureFixture[str]) -> str:
    fit("agent", "--trainer.default_root_dir=agents")
    (checkpoint,) = Path("agents").rglob("*.ckpt")
    return refused(capsys, "agent", "fit", NO_LOGGER, f"--ckpt_path={checkpoint}", "--model.algorithm=bc")


@pytest.mark.parametrize(
    ("flags", "kind"),
    [
        ([], None),
        (["--model.kind", "ensemble"], "ensemble"),
        (["--model.kind=ensemble", "--model.kind=transformer"], "transformer"),
        (["--config=own.yaml"], "ensemble"),
        (["-c", "below.yaml"], "ensemble"),
        (["--config", "own.yaml", "--model.kind=transformer"], "transformer"),
        (["--model.kind=transformer", "--config", "own.yaml"], "ensemble"),
        (["--config", "null.yaml"], None),
        (["--config", "odd.yaml"], None),
        (["--config", "missing.yaml", "--model.kindness=x"], None),
    ],
)
def test_what_is_given_is_found_in_flags_and_files(
    flags: list[str], kind: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("own.yaml").write_text("model: {kind: ensemble}")
    Path("below.yaml").write_text("fit: {model: {kind: ensemble}}\nvalidate: {model: {kind: transformer}}")
    Path("null.yaml").write_text("model: {kind: null}")
    Path("odd.yaml").write_text("model: [")
    assert given("model.kind", ["fit", *flags]) == kind


@pytest.mark.parametrize("place", ["--model.kin=ensemble", '--model={"kind": "ensemble"}'])
def test_a_kind_that_is_given_elsewhere_is_refused(
    place: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "give the flag --model.kind" in refused(capsys, "model", "fit", NO_LOGGER, place)
    assert "did you mean 'ensemble'?" in refused(capsys, "model", "fit", NO_LOGGER, "--model.kind=ensembel")


@pytest.mark.parametrize(
    ("kind", "options", "sentence"),
    [
        ("model", {"updates": 5}, "model.options.updates is 5: take a multiple of its updates_per_epoch (2)"),
        ("model", {"width": 6}, "model.options.width is 6 and heads is 2"),
        ("ensemble", {"weight_decay": [0]}, "model.options.weight_decay has 1 entries and there are 2"),
        ("ensemble", {"elites": 4}, "model.options.elites is 4 and members is 3"),
        ("agent", {"updates_per_epoch": 1}, "model.options.updates_per_epoch is 1: take a multiple of 10"),
        ("agent", {"updates": 25}, "model.options.updates is 25: take a multiple of its updates_per_epoch (10)"),
    ],
)
def test_options_are_held_to_the_rules_of_params(
    kind: str, options: dict[str, object], sentence: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if kind == "ensemble":
        with pytest.raises(SystemExit):
            fit_ensemble("--model.kind=ensemble", **options)
        assert sentence in capsys.readouterr().err
    else:
        assert sentence in refused(capsys, kind, "fit", NO_LOGGER, **{**SIZES[kind], **RUN[kind], **options})
    assert not Path(".envtf").exists()


@pytest.mark.parametrize(
    ("kind", "option", "value", "rule"),
    [
        ("model", "updates_per_epoch", 0, "v>0"),
        ("model", "context", 0, "v>0"),
        ("model", "dropout", 1.0, "v<1"),
        ("model", "layers", 1.5, "invalid literal"),
        ("agent", "updates_per_epoch", 0, "v>0"),
        ("agent", "warm_start", -0.1, "v>=0"),
        ("agent", "hidden", [0], "v>0"),
    ],
)
def test_options_are_held_to_the_ranges_of_params(
    kind: str, option: str, value: object, rule: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        fit(kind, **{option: value})
    said = capsys.readouterr().err
    assert stop.value.code == 2 and f"model.options.{option}" in said and rule in said and "Traceback" not in said
    assert not Path(".envtf").exists()


def test_a_negative_seed_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "model.seed is -1, expected an integer, 0 or more" in refused(capsys, "model", "fit", "--model.seed=-1")


def test_a_share_of_held_out_episodes_is_one(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for kind, share in (("model", "0"), ("model", "1"), ("agent", "1.5"), ("agent", "-0.1")):
        assert "data.held_out is" in refused(capsys, kind, "fit", f"--data.held_out={share}")


def test_the_command_lines_defaults_are_the_pipelines(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert printed_config(capsys, "model")["data"]["held_out"] == DownloadOptions().held_out
    agent = printed_config(capsys, "agent")
    assert agent["data"]["held_out"] == 0.0  # all rows, as for a robot whose simulator can score it
    assert agent["model"]["options"] == json.loads(json.dumps(asdict(CQLOptions())))


def printed_config(capsys: pytest.CaptureFixture[str], kind: str) -> dict[str, Any]:
    with pytest.raises(SystemExit) as stop:
        envtf(kind, "validate", "--print_config")
    assert stop.value.code == 0
    return YAML(typ="safe", pure=True).load(capsys.readouterr().out)


def test_data_take_what_the_options_say(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, Any] = {}

    def note(data: WindowData | TransitionData, stage: str) -> None:
        seen.update(vars(data))
        raise UserError("That is enough.")

    for cls in (WindowData, TransitionData):
        monkeypatch.setattr(cls, "setup", note)
    for flags, expected in (
        (["model", "--model.options.context=3"], {"context": 3, "members": None, "updates_per_epoch": 1_000}),
        (["model", "--model.options.batch_size=8", "--model.seed=2"], {"batch_size": 8, "seed": 2, "share": 0.1}),
        (["model", "--model.kind=ensemble"], {"context": 1, "members": 7, "batch_size": 256}),
        (["agent", "--model.options.discount=0.5", "--model.options.n_step=3"], {"discount": 0.5, "n_step": 3}),
        (["agent", "--model.seed=2"], {"return_temperature": 0.1, "steps_per_epoch": 50, "seed": 2}),
        (["agent", "--model.options.return_temperature=null"], {"return_temperature": None, "batch_size": 256}),
    ):
        seen.clear()
        with pytest.raises(SystemExit):
            envtf(flags[0], "fit", NO_LOGGER, *flags[1:])
        assert {name: seen[name] for name in expected} == expected, flags


@pytest.mark.parametrize(
    ("kind", "parts", "sentence"),
    [
        ("model", "[block]", "no part 'block' to freeze: did you mean 'blocks'?"),
        ("model", "[embed, blocks, norm, head]", "leaves nothing to train"),
        ("agent", "[nets]", "no part 'nets' to freeze"),
    ],
)
def test_what_cannot_be_frozen_is_refused(
    kind: str, parts: str, sentence: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sentence in refused(
        capsys, kind, "fit", NO_LOGGER, f"--model.freeze={parts}", **{**SIZES[kind], **RUN[kind]}
    )


def test_flags_of_earlier_versions_are_taken_as_they_are_called_now() -> None:
    flags = ["fit", "--model.options.model.layers", "1", "--model.options.updates_per_step=10", "--data.path=model.h5"]
    assert of_today(flags) == ["fit", "--model.options.layers", "1", "--data.path=model.h5"]
    assert of_today(["fit", "--model.options.critics", "2", "--model.seed=1"]) == ["fit", "--model.seed=1"]
    with pytest.raises(UserError, match=r"updates_per_step is 7, and always 10 by now"):
        of_today(["--model.options.updates_per_step", "7"])


@pytest.mark.parametrize(
    ("flag", "sentence"),
    [
        ("--trainer.precision=bf16-true", "give 32-true, or bf16-mixed"),
        ("--trainer.precision=16-true", "give 32-true, or bf16-mixed"),
        ("--ckpt_path=best", "give the path of a checkpoint, or last"),
    ],
)
def test_what_lightning_takes_and_no_model_here_can_is_refused(
    flag: str, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    enter_project(tmp_path, monkeypatch)
    assert sentence in refused(capsys, "model", "fit", NO_LOGGER, flag, **SIZES["model"], **RUN["model"])
