"""Reading and writing `params.yaml`: code defaults < preset < params.yaml < command line."""

import dataclasses
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal, get_origin, get_type_hints

from docstring_parser import parse as parse_docstring
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent

from envtf_lit.errors import UserError, did_you_mean
from envtf_lit.files import check_plain
from envtf_lit.options.schema import kind, options_class
from envtf_lit.pipeline.params import COMMON, Params, algorithm_of, algorithms, build_params, kind_of
from envtf_lit.pipeline.renamed_options import refuse_former
from envtf_lit.world_models.options import KINDS

PRESETS = ("tiny", "small", "base", "paper")
WIDTH = 120
MOST_TEXT = 64 << 10  # bytes of params.yaml, of which the longest preset has a tenth; more takes seconds to read
MOST_VALUES, MOST_BRACKETS = 10_000, 1_000
NAMED = {"train_model": "kind", "train_policy": "algorithm"}  # stages with named sections, and the tag of each


def load_params(path: str | Path = "params.yaml", overrides: Sequence[str] = ()) -> Params:
    """The options in a YAML file, with `key.subkey=value` overrides on top; what is absent takes its default.

    YAML 1.2, so that `3e-4` is a number.

    Raises:
        UserError: no such file, not YAML, or an option that is unknown, of the wrong type or out of range.
    """
    path = Path(path)
    try:
        check_plain(path, MOST_TEXT)
        text = path.read_text()
    except FileNotFoundError:
        raise UserError(f"{path} does not exist: run `envtf init .` to write one, or give --params.") from None
    except UserError:
        raise
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"Cannot read {path} ({error}): give a YAML file.") from None
    try:
        values = _parse(text, str(path)) or {}
        if not isinstance(values, Mapping):
            raise UserError(f"the file holds {values!r}, expected a section of options, such as `seed: 0`.")
        missing = {name: dump_params(Params())[name] for name in NAMED if name not in values}
        tree = _overlay({**values, **missing}, *map(_override, overrides))
        refuse_former(tree)
        return build_params(tree)
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
    below, preset = dump_params(Params()), _parse(text, name) or {}
    for stage, tag in NAMED.items():
        for section, values in preset.get(stage, {}).items():
            if tag in values:  # another algorithm, which has other options
                below[stage].pop(section, None)
    return build_params(_overlay(below, preset))


def dump_params(params: Params) -> dict[str, Any]:
    """All options as nested dictionaries of numbers, strings, lists and None: ready for JSON, and for `build_params`.

    A policy's section has its algorithm, the options of its own, and those of `policy` in which it differs.
    """
    tree = dataclasses.asdict(params)
    for name, model in params.train_model.items():
        tree["train_model"][name] = {"kind": kind_of(model)} | dataclasses.asdict(model)
    for name, options in params.train_policy.items():
        common = dataclasses.asdict(params.policy)
        own = {key: x for key, x in dataclasses.asdict(options).items() if key not in COMMON or x != common[key]}
        tree["train_policy"][name] = {"algorithm": algorithm_of(options)} | own
    return json.loads(json.dumps(tree))  # tuples become lists


def params_yaml(params: Params) -> str:
    """All options as YAML text, each with its meaning beside it: what `envtf init` writes."""
    head = (
        "# The options of every stage. Change a number, then `dvc repro`: only what depends on it runs again.\n"
        "# Rarer ones stand in `envtf train_policy --help` (or another stage's), and can be written here, too."
    )
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
    names = section.split(".")
    cls, values = Params, dump_params(Params() if names[0] == "train_policy" else Params(train_policy={}))
    for depth, name in enumerate(names[:-1]):
        cls, values = _section(cls, name, values[name], names[depth - 1] if depth else ""), values[name]
    parent = names[-2] if len(names) > 1 else ""
    return list(_options(cls, names[-1], values[names[-1]], ".".join(names), parent))


def _options(cls: Any, name: str, value: Any, key: str, parent: str = "") -> Iterator[Option]:
    inner = _section(cls, name, value, parent)
    if inner is None:
        yield Option(key, kind(get_type_hints(cls)[name]), value, meanings(cls)[name])
    elif value is not None:
        names = value if parent == "" and name in NAMED else [n for n in _fields(inner) if n in value]
        for below in names:
            yield from _options(inner, below, value[below], f"{key}.{below}", name)


def _fields(cls: Any) -> list[str]:
    return [field.name for field in dataclasses.fields(cls)]


def _section(cls: Any, name: str, value: Any, parent: str) -> Any:
    """The dataclass behind a name, or None where it is a plain value; below a stage with named sections by its tag."""
    if parent in NAMED:
        tag = value[NAMED[parent]]
        return KINDS[tag] if parent == "train_model" else algorithms()[tag].Options
    if cls is Params and name in NAMED:
        return Params
    return options_class(get_type_hints(cls)[name])


@cache
def meanings(cls: type) -> dict[str, str]:
    """What each field of an options class means, from its docstring and those of the classes it extends."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        parsed = parse_docstring(base.__doc__ or "").params
        found |= {p.arg_name: " ".join((p.description or "").split()) for p in parsed}
    return found


def _parse(text: str, where: str) -> Any:
    if text.count("[") + text.count("{") > MOST_BRACKETS:  # each level of which is looked at again for every one below
        raise UserError(f"{where} has more than {MOST_BRACKETS:,} opening brackets: write what an option asks for.")
    try:
        if "*" in text:
            _check_aliases(text, where)
        return YAML(typ="safe", pure=True).load(text)
    except RecursionError:
        raise UserError(f"{where} is not valid YAML: brackets in brackets, far too deep.") from None
    except YAMLError as error:
        raise UserError(f"{where} is not valid YAML: {' '.join(str(error).split())}") from None


def _check_aliases(text: str, where: str) -> None:
    """Refuses aliases of aliases that stand for far more than they are: ten lines make a thousand million values."""
    sizes, opened, size = dict[str, int](), list[tuple[str | None, int]](), 0
    for event in YAML(typ="safe", pure=True).parse(text):
        name: str | None = getattr(event, "anchor", None)
        size += sizes.get(name or "", 1) if isinstance(event, AliasEvent) else 1
        if isinstance(event, CollectionStartEvent):
            opened.append((name, size))
        elif isinstance(event, CollectionEndEvent):
            name, begin = opened.pop()
            if name is not None:
                sizes[name] = size - begin
        if size > MOST_VALUES:
            raise UserError(f"{where} stands for more than {MOST_VALUES:,} values, by its aliases: write them out.")


def _override(text: str) -> dict[str, Any]:
    """`a.b=1` as {"a": {"b": 1}}."""
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise UserError(f"{text!r} is not an override: write key=value, such as policy.updates=9000.")
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


def _yaml_lines(cls: Any, values: Mapping[str, Any], depth: int, explained: set[str]) -> Iterator[str]:
    """One line an option; an option that comes twice with the same meaning is explained once."""
    rare = {field.name: field.default for field in dataclasses.fields(cls) if field.metadata.get("rare")}
    for name, value in values.items():
        if name in rare and rare[name] == value:
            continue
        nested = isinstance(value, Mapping)
        line = f"{'  ' * depth}{name}:" + ("" if nested else f" {_scalar(value)}")
        if depth == 0 and nested:
            yield ""
        yield _commented(line, cls, name, explained)
        if not nested:
            continue
        if depth == 0 and name in NAMED:
            for below, section in value.items():
                yield from _named_lines(name, below, section, explained)
        else:
            yield from _yaml_lines(_section(cls, name, value, ""), value, depth + 1, explained)


def _named_lines(stage: str, name: str, values: Mapping[str, Any], explained: set[str]) -> Iterator[str]:
    """A named section: its tag with the choices, then its options."""
    tag, choices = NAMED[stage], KINDS if stage == "train_model" else algorithms()
    yield f"  {name}:"
    line, meaning = f"    {tag}: {values[tag]}", " | ".join(choices)
    yield line if meaning in explained else f"{line}  # {meaning}"
    explained.add(meaning)
    rest = {key: value for key, value in values.items() if key != tag}
    yield from _yaml_lines(_section(None, name, values, stage), rest, 2, explained)


def _commented(line: str, cls: Any, name: str, explained: set[str]) -> str:
    """The choices, or the meaning where it fits, else its first clause: `envtf COMMAND --help` has the whole of it."""
    hint, meaning = get_type_hints(cls)[name], meanings(cls)[name].rstrip(".")
    if f"{name}: {meaning}" in explained:
        return line
    explained.add(f"{name}: {meaning}")
    if get_origin(hint) is Literal:
        return f"{line}  # {kind(hint)}"
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
