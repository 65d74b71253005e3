"""What a Lightning command line says of a few options before there is a parser, which depends on them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from envtf_lit.errors import UserError

CONFIGS = Path(__file__).parent.parent / "configs"
SHIPPED = ", ".join(sorted(path.stem for path in CONFIGS.glob("*.yaml")))
CONFIG = ("--config", "-c")
MOVED = ("--model.options.model.", "--model.options.")  # of earlier versions, and of today
CONSTANTS = {f"--model.options.{name}": value for name, value in (("updates_per_step", 10), ("critics", 2))}


def with_shipped_configs(arguments: list[str]) -> list[str]:
    """The arguments, with `--config NAME` of a shipped configuration as its path."""
    found = list[str]()
    for before, argument in zip(["", *arguments], arguments, strict=False):
        flag, _, value = argument.rpartition("=")
        if before in CONFIG or flag == "--config":
            shipped = CONFIGS / f"{value}.yaml"
            value = str(shipped) if shipped.is_file() and not Path(value).exists() else value
        found.append(f"{flag}={value}" if flag else value)
    return found


def of_today(arguments: list[str]) -> list[str]:
    """The arguments, with flags of earlier versions as they are called now; what is a constant now is left out.

    Raises:
        UserError: another value is asked of a constant.
    """
    found, waiting = list[str](), None
    for argument in (argument.replace(*MOVED) if argument.startswith("--") else argument for argument in arguments):
        flag, equals, value = argument.partition("=")
        if waiting is not None or (flag in CONSTANTS and equals):
            name, value = waiting or flag, argument if waiting else value
            if value != str(CONSTANTS[name]):
                raise UserError(f"{name} is {value}, and always {CONSTANTS[name]} by now: leave it out.")
            waiting = None
        elif flag in CONSTANTS:
            waiting = flag
        else:
            found.append(argument)
    return found


def given(key: str, arguments: list[str]) -> str | None:
    """The value of an option, such as `model.kind`, in flags and --config files; the last one counts.

    An odd file is for the parser to refuse.
    """
    found = None
    for flag, value in _pairs(arguments):
        if flag in CONFIG:
            for section in _sections(Path(value), arguments):
                found = _at(section, key.split("."), found)
        elif flag == f"--{key}":
            found = value
    return None if found in (None, "null") else str(found)


def _pairs(arguments: list[str]) -> Iterator[tuple[str, str]]:
    """Each flag with its value, whether it is `--flag value` or `--flag=value`."""
    for argument, following in zip(arguments, [*arguments[1:], ""], strict=True):
        flag, equals, value = argument.partition("=")
        yield flag, value if equals else following


def _sections(path: Path, arguments: list[str]) -> Iterator[Any]:
    """A configuration file's content, and what stands there below the verb."""
    try:
        tree = YAML(typ="safe", pure=True).load(path.read_text("utf-8"))
    except (OSError, ValueError, YAMLError):
        return
    yield tree
    if isinstance(tree, dict):
        yield from (section for verb, section in tree.items() if verb in arguments)


def _at(tree: Any, names: list[str], otherwise: Any) -> Any:
    """The value at a place of nested dictionaries, or another where there is none."""
    for name in names:
        if not isinstance(tree, dict) or name not in tree:
            return otherwise
        tree = tree[name]
    return tree
