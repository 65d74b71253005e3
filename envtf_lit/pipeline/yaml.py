"""Reading and writing `params.yaml`: code defaults < preset < params.yaml < command line."""

import dataclasses
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from docstring_parser import parse as parse_docstring
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from envtf_lit.errors import UserError, did_you_mean
from envtf_lit.pipeline.params import Params, build_params

PRESETS = ("tiny", "small", "base", "paper")
WIDTH = 120


def load_params(path: str | Path = "params.yaml", overrides: Sequence[str] = ()) -> Params:
    """The options in a YAML file, with `key.subkey=value` overrides on top; what is absent takes its default.

    YAML 1.2, so that `3e-4` is a number.

    Raises:
        UserError: no such file, not YAML, or an option that is unknown, of the wrong type or out of range.
    """
    path = Path(path)
    try:
        text = path.read_text()
    except FileNotFoundError:
        raise UserError(f"{path} does not exist: run `envtf init .` to write one, or give --params.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"Cannot read {path} ({error}): give a YAML file.") from None
    values = _parse(text, str(path)) or {}
    try:
        return build_params(_overlay(dump_params(Params()), values, *map(_override, overrides)))
    except UserError as error:
        raise UserError(f"{path}: {error}" if not overrides else str(error)) from None


def preset_params(name: str) -> Params:
    """The options of a shipped preset: tiny (seconds), small (a quarter of an hour on 2 cores), base, paper.

    Raises:
        UserError: no preset of that name.
    """
    if name not in PRESETS:
        raise UserError(f"Unknown preset {name!r}: {did_you_mean(name, PRESETS)}")
    text = resources.files("envtf_lit").joinpath(f"configs/presets/{name}.yaml").read_text()
    return build_params(_overlay(dump_params(Params()), _parse(text, name) or {}))


def dump_params(params: Params) -> dict[str, Any]:
    """All options as nested dictionaries of numbers, strings, lists and None: ready for JSON."""
    return json.loads(json.dumps(dataclasses.asdict(params)))  # tuples become lists


def params_yaml(params: Params) -> str:
    """All options as YAML text, each with its meaning beside it: what `envtf init` writes."""
    head = "# Every option of every stage. Change a number, then `dvc repro`: only what depends on it runs again."
    return "\n".join([head, *_yaml_lines(Params, dump_params(params), 0, set())]) + "\n"


@dataclasses.dataclass(frozen=True)
class Option:
    """One option as the command line's help shows it."""

    key: str
    kind: str
    default: Any
    meaning: str


def describe(section: str) -> list[Option]:
    """The options of a part of `params.yaml`, such as `seed` or `train_policy.cql`, with defaults and meanings."""
    cls, values = Params, dump_params(Params())
    names = section.split(".")
    for name in names[:-1]:
        cls, values = _section(cls, name), values[name]
    return list(_options(cls, names[-1], values[names[-1]], ".".join(names)))


def _options(cls: Any, name: str, value: Any, key: str) -> Iterator[Option]:
    inner = _section(cls, name)
    if inner is None:
        yield Option(key, _kind(get_type_hints(cls)[name]), value, meanings(cls)[name])
    elif value is not None:
        for field in dataclasses.fields(inner):
            yield from _options(inner, field.name, value[field.name], f"{key}.{field.name}")


def _section(cls: Any, name: str) -> Any:
    """The dataclass behind a field, looking through `X | None`, or None where it is a plain value."""
    hint = get_type_hints(cls)[name]
    return next((x for x in (hint, *get_args(hint)) if dataclasses.is_dataclass(x)), None)


def _kind(hint: Any) -> str:
    if get_origin(hint) is Literal:
        return " | ".join(get_args(hint))
    if get_origin(hint) is tuple:
        return f"list of {_kind(get_args(hint)[0])}"
    return hint.__name__ if isinstance(hint, type) else str(hint).replace("None", "null")


@cache
def meanings(cls: type) -> dict[str, str]:
    """What each field of an options class means, from its docstring."""
    return {p.arg_name: " ".join((p.description or "").split()) for p in parse_docstring(cls.__doc__ or "").params}


def _parse(text: str, where: str) -> Any:
    try:
        return YAML(typ="safe", pure=True).load(text)
    except YAMLError as error:
        raise UserError(f"{where} is not valid YAML: {' '.join(str(error).split())}") from None


def _override(text: str) -> dict[str, Any]:
    """`a.b=1` as {"a": {"b": 1}}."""
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise UserError(f"{text!r} is not an override: write key=value, such as train_model.updates=500.")
    tree: Any = _parse(value, f"The value of {key}")
    for name in reversed(key.split(".")):
        tree = {name: tree}
    return tree


def _overlay(below: Any, *above: Any) -> Any:
    """Nested dictionaries laid over one another: the later wins, key by key."""
    for tree in above:
        if not (isinstance(below, Mapping) and isinstance(tree, Mapping)):
            below = tree
        else:
            below = {**below, **{key: _overlay(below.get(key), value) for key, value in tree.items()}}
    return below


def _yaml_lines(cls: Any, values: Mapping[str, Any], depth: int, explained: set[tuple[type, str]]) -> Iterator[str]:
    """One line an option; an options class that comes twice is explained once."""
    for field in dataclasses.fields(cls):
        value = values[field.name]
        nested = isinstance(value, Mapping)
        line = f"{'  ' * depth}{field.name}:" + ("" if nested else f" {_scalar(value)}")
        if depth == 0 and nested:
            yield ""
        yield line if (cls, field.name) in explained else _commented(line, cls, field.name)
        explained.add((cls, field.name))
        if nested:
            yield from _yaml_lines(_section(cls, field.name), value, depth + 1, explained)


def _commented(line: str, cls: Any, name: str) -> str:
    """The choices, or the meaning where it fits, else its first clause: `envtf COMMAND --help` has the whole of it."""
    hint, meaning = get_type_hints(cls)[name], meanings(cls)[name].rstrip(".")
    if get_origin(hint) is Literal:
        return f"{line}  # {_kind(hint)}"
    whole = f"{line}  # {meaning}"
    return whole if len(whole) <= WIDTH else f"{line}  # {re.split(r'[;.:] | [(]', meaning)[0]}"


def _scalar(value: Any) -> str:
    """YAML that every reader takes alike: 0.0003 rather than 3e-4, which is text to YAML 1.1."""
    if isinstance(value, float):
        return format(Decimal(repr(value)), "f")
    if isinstance(value, list):
        return f"[{', '.join(map(_scalar, value))}]"
    if isinstance(value, str) and re.fullmatch(r"[A-Za-z][\w./-]*", value):
        return value
    return json.dumps(value)
