"""From a tree of plain values to dataclasses of options: types, ranges, and the nearest name of what is unknown."""

import dataclasses
import math
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, Protocol, Union, get_args, get_origin, get_type_hints

from envtf_lit.errors import UserError, did_you_mean

Precision = Literal["fp32", "bf16"]


class Range(NamedTuple):
    """A test of a number and the words for what passes it."""

    passes: Callable[[float], bool]
    words: str


_FINITE = Range(math.isfinite, "finite")
_COUNT = Range(lambda value: value >= 1, "1 or more")
_NOT_NEGATIVE = Range(lambda value: value >= 0, "0 or more")
_POSITIVE = Range(lambda value: value > 0, "more than 0")
_SHARE = Range(lambda value: 0 <= value < 1, "in [0, 1)")
_INNER_SHARE = Range(lambda value: 0 < value < 1, "in (0, 1)")
_NONZERO_SHARE = Range(lambda value: 0 < value <= 1, "in (0, 1]")
# by the option's name, wherever it stands; of a list, for each of its items
RANGES: dict[str, Range] = {
    **dict.fromkeys(("threads", "layers", "heads", "width", "context", "updates", "updates_per_epoch"), _COUNT),
    **dict.fromkeys(("updates_per_step", "batch_size", "clone_updates", "clone_batch_size", "branches"), _COUNT),
    **dict.fromkeys(("horizon", "buffer_size", "hidden", "critics", "sampled_actions", "episodes"), _COUNT),
    **dict.fromkeys(("trajectories", "n_step", "selection_steps", "members", "elites", "patience"), _COUNT),
    **dict.fromkeys(("rollouts", "share", "max_steps", "value_passes", "multi_step"), _COUNT),
    **dict.fromkeys(
        ("seed", "weight_decay", "history", "exploration", "refresh_every", "penalty", "tail", "posterior"),
        _NOT_NEGATIVE,
    ),
    **dict.fromkeys(
        ("cql_weight", "clone_weight", "warm_start", "selection_episodes", "random_features"), _NOT_NEGATIVE
    ),
    **dict.fromkeys(("learning_rate", "actor_learning_rate", "critic_learning_rate", "value_learning_rate"), _POSITIVE),
    **dict.fromkeys(
        (
            "warm_start_learning_rate",
            "eps",
            "gradient_clip",
            "temperature",
            "initial_alpha",
            "return_temperature",
            "novelty_limit",
        ),
        _POSITIVE,
    ),
    **dict.fromkeys(("dropout", "scheduled_sampling", "any_step", "warmup", "discount", "trace"), _SHARE),
    "held_out": _INNER_SHARE,
    **dict.fromkeys(("real_ratio", "target_rate", "actor_average"), _NONZERO_SHARE),
    "transitions": Range(lambda value: value >= 1000, "1000 or more"),
    "video_frames": Range(lambda value: 2 <= value <= 150, "from 2 to 150"),
}


def build_section(cls: type, values: Mapping[str, Any], section: str) -> Any:
    """One options class from a tree of plain values, types and ranges checked.

    Args:
        cls: of the options, such as `TrainModelOptions`.
        values: by name; what is absent takes its default.
        section: what errors call it, such as `train_model`.

    Raises:
        UserError: an unknown option, or a value of the wrong type or out of range.
    """
    return build(cls, values, section)


def _refuse(key: str, value: Any, expected: str) -> typing.NoReturn:
    shown = "null" if value is None else repr(value)
    raise UserError(f"{key or 'The top level'} is {shown}, expected {expected}.")


def build(cls: type, value: Any, key: str) -> Any:
    if not isinstance(value, Mapping):
        _refuse(key, value, f"a section with the keys {', '.join(field.name for field in dataclasses.fields(cls))}")
    hints = get_type_hints(cls)
    for name in value:
        if name not in hints:
            where = f"in {key}" if key else "at the top level"
            raise UserError(f"Unknown option {name!r} {where}: {did_you_mean(str(name), hints)}")
    prefix = f"{key}." if key else ""
    return cls(**{name: _value(hints[name], item, prefix + name, name) for name, item in value.items()})


def _value(hint: Any, value: Any, key: str, name: str) -> Any:
    origin, arguments = get_origin(hint), get_args(hint)
    if dataclasses.is_dataclass(hint):
        return build(typing.cast(type, hint), value, key)
    if origin in (Union, types.UnionType):  # `X | None` is the only union
        return None if value is None else _value(arguments[0], value, key, name)
    if origin is tuple:
        if not isinstance(value, list | tuple) or not value:
            _refuse(key, value, "a list such as [256, 256]")
        return tuple(_value(arguments[0], item, key, name) for item in value)
    if origin is Literal:
        if value not in arguments:
            raise UserError(f"{key} is {value!r}: {did_you_mean(str(value), arguments)}")
        return value
    return _number(hint, value, key, name) if hint in (int, float) else _plain(hint, value, key)


def _plain(hint: type, value: Any, key: str) -> Any:
    if not isinstance(value, hint):
        _refuse(key, value, {bool: "true or false", str: "a text"}[hint])
    return value


def _number(hint: type, value: Any, key: str, name: str) -> Any:
    kind = "an integer" if hint is int else "a number"
    limits = RANGES.get(name, _FINITE)
    if isinstance(value, bool) or not isinstance(value, int | float) or not _is_finite(value):
        _refuse(key, value, f"{kind}, {limits.words}")
    if hint is int and value != int(value):  # 1e6 is a float to YAML and a fine count to everybody
        _refuse(key, value, f"{kind}, {limits.words}")
    if not limits.passes(value):
        _refuse(key, value, f"{kind}, {limits.words}")
    return hint(value)


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


def check_epochs(section: str, options: Budget) -> None:
    """A training is whole epochs.

    Raises:
        UserError: it isn't.
    """
    if options.updates % options.updates_per_epoch:
        raise UserError(
            f"{section}.updates is {options.updates}: take a multiple of its updates_per_epoch "
            f"({options.updates_per_epoch})."
        )
