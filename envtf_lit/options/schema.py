"""From a tree of plain values to dataclasses of options: types, ranges, and the nearest name of what is unknown."""

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal, Protocol, TypeVar, Union, get_args, get_origin, get_type_hints

from envtf_lit.errors import UserError, did_you_mean

Precision = Literal["auto", "fp32", "bf16"]
Options = TypeVar("Options")


def rare(default: Any) -> Any:
    """A dataclass field that few change: `params.yaml` names it only where it differs from this default."""
    return dataclasses.field(default=default, metadata={"rare": True})


def build(cls: type[Options], values: Any, section: str) -> Options:
    """One options class from a tree of plain values, types and ranges checked; what is absent takes its default.

    Args:
        cls: a dataclass of options, whose annotations name types and ranges (`options.numbers`).
        values: by name.
        section: what errors call it, such as `train_model.transformer`; empty for the top level.

    Raises:
        UserError: an unknown option (with the nearest known one), or a value of the wrong type or out of range.
    """
    hints = get_type_hints(cls)
    if not isinstance(values, Mapping):
        _refuse(section, values, f"a section with the keys {', '.join(hints)}")
    for name in values:
        if name not in hints:
            where = f"in {section}" if section else "at the top level"
            raise UserError(f"Unknown option {name!r} {where}: {did_you_mean(str(name), hints)}")
    prefix = f"{section}." if section else ""
    built = {name: _value(hints[name], item, prefix + name) for name, item in values.items()}
    try:
        return cls(**built)
    except UserError as error:  # a rule of the class, which does not know its own place
        raise UserError(f"{prefix}{error}") from None


def build_tagged(classes: Mapping[str, type[Options]], tag: str, values: Any, section: str) -> Options:
    """The options class that a key of the section names, from the rest of it.

    Args:
        classes: by the tag's value.
        tag: the key, such as `algorithm`.
        values: by name, the tag among them.
        section: what errors call it, such as `train_policy.cql`.

    Raises:
        UserError: no such tag, an unknown one (with the nearest known one), or what `build` raises.
    """
    if not isinstance(values, Mapping):
        _refuse(section, values, f"a section with the key {tag}")
    if tag not in values:
        raise UserError(
            f"{section} has no {tag}: add a line such as `{tag}: {next(iter(classes))}` ({' | '.join(classes)})."
        )
    name = str(values[tag])
    if name not in classes:
        raise UserError(f"{section}.{tag} is {values[tag]!r}: {did_you_mean(name, classes)}")
    return build(classes[name], {key: value for key, value in values.items() if key != tag}, section)


def rebuild(options: Options) -> Options:
    """The same options from plain numbers, checked: whatever put them together.

    Raises:
        UserError: one is of the wrong type or out of range.
    """
    return build(type(options), dataclasses.asdict(typing.cast(Any, options)), "")


def options_class(hint: Any) -> type | None:
    """The dataclass behind an annotation, looking through `X | None`, or None where it is a plain value."""
    return next((x for x in (hint, *get_args(hint)) if dataclasses.is_dataclass(x) and isinstance(x, type)), None)


def kind(hint: Any) -> str:
    """An annotation in words: `int, 1 or more`, `relu | gelu`, `list of …`."""
    if get_origin(hint) is Literal:
        return " | ".join(get_args(hint))
    if get_origin(hint) is tuple:
        return f"list of {kind(get_args(hint)[0])}"
    if get_origin(hint) in (Union, types.UnionType):
        return " | ".join("null" if x is type(None) else kind(x) for x in get_args(hint))
    return f"{_base(hint).__name__}, {_range(hint)}" if _is_number(hint) else hint.__name__


def _refuse(key: str, value: Any, expected: str) -> typing.NoReturn:
    shown = "null" if value is None else repr(value)
    raise UserError(f"{key or 'The top level'} is {shown}, expected {expected}.")


def _value(hint: Any, value: Any, key: str) -> Any:
    origin, arguments = get_origin(hint), get_args(hint)
    if dataclasses.is_dataclass(hint):
        return build(typing.cast(type, hint), value, key)
    if origin in (Union, types.UnionType):  # `X | None` is the only union
        return None if value is None else _value(arguments[0], value, key)
    if origin is tuple:
        if not isinstance(value, list | tuple) or not value:
            _refuse(key, value, "a list such as [256, 256]")
        return tuple(_value(arguments[0], item, key) for item in value)
    if origin is Literal:
        if value not in arguments:
            raise UserError(f"{key} is {value!r}: {did_you_mean(str(value), arguments)}")
        return value
    if _is_number(hint):
        return _number(hint, value, key)
    if not isinstance(value, hint):
        _refuse(key, value, {bool: "true or false", str: "a text"}[hint])
    return value


def _is_number(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, int | float) and hint is not bool


def _base(hint: type) -> type:
    return int if issubclass(hint, int) else float


def _range(hint: type) -> str:
    """In words: `1 or more`, `in [0, 1)`, or `finite` where there is none."""
    bounds: list[tuple[Any, float]] = getattr(hint, "_restrictions", [])
    signs = {test.__name__: bound for test, bound in bounds}
    if len(bounds) == 2:
        low, high = next(iter(bounds))[1], bounds[1][1]
        return f"in {'[' if 'ge' in signs else '('}{low}, {high}{']' if 'le' in signs else ')'}"
    if not bounds:
        return "finite"
    return f"{signs['ge']} or more" if "ge" in signs else f"more than {signs['gt']}"


def _number(hint: type, value: Any, key: str) -> int | float:
    base = _base(hint)
    whole = isinstance(value, int | float) and not isinstance(value, bool) and _is_finite(value)
    if whole and base is int:
        whole = value == int(value)  # 1e6 is a float to YAML and a fine count to everybody
    if not whole or not all(test(value, bound) for test, bound in getattr(hint, "_restrictions", [])):
        _refuse(key, value, f"{'an integer' if base is int else 'a number'}, {_range(hint)}")
    return base(value)


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond all floats
        return False


class Budget(Protocol):
    """How long something is trained, in gradient steps."""

    @property
    def updates(self) -> int: ...

    @property
    def updates_per_epoch(self) -> int: ...


def check_epochs(options: Budget) -> None:
    """A training is whole epochs.

    Raises:
        UserError: it isn't.
    """
    if options.updates % options.updates_per_epoch:
        raise UserError(
            f"updates is {options.updates}: take a multiple of its updates_per_epoch ({options.updates_per_epoch})."
        )
