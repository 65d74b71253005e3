"""Published folders and checkpoints that want to run code: data become options through our schema, or are refused."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from envtf_lit.agents.cql import CQLOptions
from envtf_lit.cli.main import main
from envtf_lit.cli.saved_options import checkpoint_options, model_architecture, policy_architecture
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.errors import UserError
from envtf_lit.world_models.options import EnsembleOptions, TransformerOptions
from tests.walker import walker_dataset

CANARY = "from pathlib import Path\nPath({ran!r}).touch()\nclass Trap:\n    pass\n"
TRAP = {"class_path": "canary.Trap"}
INJECTIONS: dict[str, Any] = {
    "class": TRAP,
    "class with arguments": {**TRAP, "init_args": {"name": "x"}, "dict_kwargs": {}},
    "name of a class": "canary.Trap",
    "list": [TRAP],
    "class as text": json.dumps(TRAP),
    "tag": "!!python/object/apply:canary.Trap []",
    "file of a config": "evil.yaml",
    "key that names a file": {"__path__": "evil.yaml"},
}
SIZES = {
    "model": {"layers": 1, "heads": 2, "width": 16, "context": 4, "batch_size": 8},
    "ensemble": {"members": 2, "elites": 1, "hidden": [8], "weight_decay": [0, 0]},
    "agent": {"hidden": [8], "batch_size": 8},
}
QUIET = ["--trainer.logger=false", "--trainer.enable_progress_bar=false", "--trainer.enable_model_summary=false"]
FOLDERS = {
    "model": ["", "kind", "arguments", "arguments.width", "arguments.activation", "arguments.class_path"],
    "ensemble": ["arguments", "arguments.hidden", "arguments.hidden.0", "arguments.members"],
    "agent": ["", "kind", "arguments", "arguments.hidden", "arguments.hidden.0", "arguments.action_low"],
}
CHECKPOINTS = {
    "model": [
        *("", "options", "seed", "freeze", "freeze.0", "options.updates"),
        *("options.width", "options.activation", "options.class_path"),
    ],
    "ensemble": ["options.hidden", "options.hidden.0", "options.class_path"],
    "agent": [
        *("options", "options.hidden.0", "options.return_temperature", "options.actor_schedule"),
        *("options.world_model", "options.rollouts", "seed", "freeze.0"),
    ],
}
OPTIONS = {"model": TransformerOptions, "ensemble": EnsembleOptions, "agent": CQLOptions}

# Lightning 2.6's use of an older jsonargparse's names
pytestmark = pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, and of each kind what an honest fit left: a published folder and a checkpoint."""
    root = tmp_path_factory.mktemp("sound")
    save_dataset(walker_dataset(), root / "dataset.h5")
    for kind, sizes in SIZES.items():
        updates = 10 if kind == "agent" else 2
        options = sizes | {"updates": updates, "updates_per_epoch": updates}
        named = [f"--model.options.{name}={value}" for name, value in options.items()]
        part = {"model": "norm", "ensemble": "biases.0", "agent": "net.2"}[kind]
        run = [f"--trainer.default_root_dir={root / kind}", f"--model.freeze=[{part}]", *QUIET]
        chosen = ["--model.kind=ensemble"] if kind == "ensemble" else []
        main([command(kind), "fit", f"--data.path={root / 'dataset.h5'}", *chosen, *named, *run])
    return root


@pytest.fixture
def ran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file that exists once anything of the canary ran; the current folder is that of a careless user."""
    ran = tmp_path / "ran"
    (tmp_path / "canary.py").write_text(CANARY.format(ran=str(ran)))
    (tmp_path / "evil.yaml").write_text("class_path: canary.Trap\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "canary", raising=False)
    monkeypatch.chdir(tmp_path)
    return ran


def command(kind: str) -> str:
    return "agent" if kind == "agent" else "model"


def replaced(tree: Any, position: str, value: Any) -> Any:
    """The tree with the value at a dotted position."""
    if not position:
        return value
    name, _, rest = position.partition(".")
    if isinstance(tree, list | tuple):
        return [replaced(item, rest, value) if str(i) == name else item for i, item in enumerate(tree)]
    return {**(tree or {}), name: replaced((tree or {}).get(name), rest, value)}


def check_refused(capsys: pytest.CaptureFixture[str], ran: Path, kind: str, sound: Path, *flags: str) -> str:
    """The command ends in a sentence, and nothing of the canary ran."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        main([command(kind), "fit", f"--data.path={sound / 'dataset.h5'}", *flags, *QUIET])
    said = capsys.readouterr().err
    assert not ran.exists()
    assert stop.value.code == 2 and "Traceback" not in said and said.startswith("envtf: "), said
    return said


def of(positions: dict[str, list[str]]) -> list[tuple[str, str]]:
    return [(kind, position) for kind, names in positions.items() for position in names]


def test_the_canary_sings(ran: Path) -> None:
    __import__("canary")
    assert ran.exists()


def changed_folder(sound: Path, kind: str, position: str, value: Any) -> Path:
    """A published folder with another value at a position of its config.json, in the current folder."""
    config = json.loads((sound / kind / "published/config.json").read_text())
    folder = Path("folder")
    folder.mkdir(exist_ok=True)
    (folder / "config.json").write_text(json.dumps(replaced(config, position, value)))
    return folder


def changed_checkpoint(sound: Path, kind: str, position: str, value: Any) -> Path:
    """A checkpoint with another value at a position of its hyper_parameters, in the current folder."""
    saved = torch.load(sound_checkpoint(sound, kind), weights_only=True)
    saved["hyper_parameters"] = replaced(saved["hyper_parameters"], position, value)
    torch.save(saved, "changed.ckpt")
    return Path("changed.ckpt")


def sound_checkpoint(sound: Path, kind: str) -> Path:
    (checkpoint,) = (sound / kind).rglob("*.ckpt")
    return checkpoint


# all that is read, as options: what is not of our schema goes no further


@pytest.mark.parametrize(("kind", "position"), of(FOLDERS))
def test_a_published_folders_options_are_of_our_schema(kind: str, position: str, sound: Path, ran: Path) -> None:
    read = policy_architecture if kind == "agent" else model_architecture
    honest = read(sound / kind / "published")
    assert honest
    for injection in INJECTIONS.values():
        folder = changed_folder(sound, kind, position, injection)
        if (kind, position) == ("agent", "arguments") or (position == "arguments" and not isinstance(injection, dict)):
            assert "canary" not in str(read(folder)) and "evil" not in str(read(folder))
        elif position in ("", "kind", "arguments.action_low"):  # for the loader alone, which has a closed registry
            assert read(folder) in ({}, honest)
        else:
            with pytest.raises(UserError, match=r"folder/config\.json: .*arguments"):
                read(folder)
    assert not ran.exists()


@pytest.mark.parametrize(("kind", "position"), of(CHECKPOINTS))
def test_a_checkpoints_options_are_of_our_schema(kind: str, position: str, sound: Path, ran: Path) -> None:
    options = OPTIONS[kind]
    assert checkpoint_options(sound_checkpoint(sound, kind), options)["seed"] == 0
    for injection in INJECTIONS.values():
        checkpoint = changed_checkpoint(sound, kind, position, injection)
        if position == "freeze.0" and injection in ("canary.Trap", "evil.yaml"):  # such a text may well name a part
            assert checkpoint_options(checkpoint, options)["freeze"] == [injection]
            continue
        if position == "options.world_model" and isinstance(injection, str):  # a name, which the command refuses
            assert checkpoint_options(checkpoint, options)["options"]["world_model"] == injection
            continue
        with pytest.raises(UserError, match=r"changed\.ckpt is not a checkpoint of this model"):
            checkpoint_options(checkpoint, options)
    assert not ran.exists()


# the whole way, through the parser


@pytest.mark.parametrize(("kind", "position"), of(FOLDERS))
def test_a_published_folder_runs_nothing(
    kind: str, position: str, sound: Path, ran: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = changed_folder(sound, kind, position, TRAP)
    (folder / "weights.safetensors").symlink_to(sound / kind / "published/weights.safetensors")
    assert "folder" in check_refused(capsys, ran, kind, sound, f"--model.init_from={folder}")


@pytest.mark.parametrize(("kind", "position"), of(CHECKPOINTS))
def test_a_checkpoint_runs_nothing(
    kind: str, position: str, sound: Path, ran: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed_checkpoint(sound, kind, position, TRAP)
    assert "changed.ckpt" in check_refused(capsys, ran, kind, sound, "--ckpt_path=changed.ckpt")


@pytest.mark.slow
@pytest.mark.parametrize("injection", INJECTIONS)
@pytest.mark.parametrize(
    ("kind", "position"),
    [
        ("model", "arguments.width"),
        ("model", "options.width"),
        ("model", "freeze.0"),
        ("ensemble", "options.hidden"),
        ("agent", "options.world_model"),
    ],
)
def test_no_injection_runs(
    kind: str, position: str, injection: str, sound: Path, ran: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if position.startswith("arguments"):
        flag = f"--model.init_from={changed_folder(sound, kind, position, INJECTIONS[injection])}"
    else:
        flag = f"--ckpt_path={changed_checkpoint(sound, kind, position, INJECTIONS[injection])}"
    check_refused(capsys, ran, kind, sound, flag)


class Reduces:
    """Unpickled, it calls what it holds."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self.call


@pytest.mark.parametrize("position", ["", "hyper_parameters", "hyper_parameters.options.updates", "state_dict", "x"])
def test_a_pickle_that_calls_a_function_is_refused(
    position: str, sound: Path, ran: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved = torch.load(sound_checkpoint(sound, "model"), weights_only=True)
    torch.save(replaced(saved, position, Reduces(exec, f"open({str(ran)!r}, 'w')")), "changed.ckpt")
    Path("link.ckpt").symlink_to("changed.ckpt")
    for name in ("changed.ckpt", "link.ckpt"):
        assert "not a checkpoint" in check_refused(capsys, ran, "model", sound, f"--ckpt_path={name}")


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, "1" * 5_000, '{"kind": "environment_transformer", "arguments": {"width": 1' + "0" * 400 + "}}"],
)
def test_json_beyond_what_python_reads_is_refused(
    text: str, sound: Path, ran: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("folder").mkdir()
    Path("folder/config.json").write_text(text)
    assert "folder" in check_refused(capsys, ran, "model", sound, "--model.init_from=folder")


def test_a_link_to_a_users_config_is_not_read_as_one(
    sound: Path, ran: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("folder").mkdir()
    Path("folder/config.json").symlink_to(Path("evil.yaml").absolute())
    assert "not valid JSON" in check_refused(capsys, ran, "model", sound, "--model.init_from=folder")
