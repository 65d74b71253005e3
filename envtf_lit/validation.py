"""From a tree of plain values to `Params`: types, ranges, and the rules that tie options together."""

import dataclasses
import math
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from envtf_lit.errors import UserError, did_you_mean
from envtf_lit.params import (
    DownloadOptions,
    EnsembleOptions,
    ImaginationOptions,
    ModelOptions,
    Params,
    PolicyOptions,
    TrainModelOptions,
)


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


def build_params(values: Mapping[str, Any]) -> Params:
    """The options in a tree of plain values; what is absent takes its default.

    Raises:
        UserError: an unknown option (with the nearest known one), a value of the wrong type or out of range, or two
            options that contradict each other.
    """
    params = _dataclass(Params, values, "")
    check_rules(params)
    return params


def build_section(cls: type, values: Mapping[str, Any], section: str) -> Any:
    """One options class from a tree of plain values, types and ranges checked.

    Args:
        cls: of the options, such as `TrainModelOptions`.
        values: by name; what is absent takes its default.
        section: what errors call it, such as `train_model`.

    Raises:
        UserError: an unknown option, or a value of the wrong type or out of range.
    """
    return _dataclass(cls, values, section)


def _refuse(key: str, value: Any, expected: str) -> typing.NoReturn:
    shown = "null" if value is None else repr(value)
    raise UserError(f"{key or 'The top level'} is {shown}, expected {expected}.")


def _dataclass(cls: type, value: Any, key: str) -> Any:
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
        return _dataclass(typing.cast(type, hint), value, key)
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
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        _refuse(key, value, f"{kind}, {limits.words}")
    if hint is int and value != int(value):  # 1e6 is a float to YAML and a fine count to everybody
        _refuse(key, value, f"{kind}, {limits.words}")
    if not limits.passes(value):
        _refuse(key, value, f"{kind}, {limits.words}")
    return hint(value)


def check_rules(params: Params) -> None:
    """The rules that tie options together.

    Raises:
        UserError: one is broken; the sentence names the options in conflict.
    """
    from envtf_lit.tasks import get_task  # late: brings in torch

    if params.task is not None:
        get_task(params.task)
    check_download(params.download, named=params.task is not None)
    check_world_model(params.train_model)
    _check_policies(params)
    _check_epistemic(params)
    _check_history("generate_rollouts", params.generate_rollouts.history, params.train_model)


def check_download(options: DownloadOptions, *, named: bool) -> None:
    """What the source needs is there, and what it has no use for is not; `named` is whether there is a task.

    Raises:
        UserError: an option is missing or not wanted.
    """
    if not named and options.source in ("zoo", "d4rl"):
        raise UserError(
            f"task is null and download.source is {options.source!r}, which has our robots' data alone: name one "
            "of the tasks, or set download.source to 'file'."
        )
    for name, needed, wanted, what in (
        ("path", ("file",), ("file", "d4rl"), "the path of your HDF5 or NPZ file"),
        ("minari_id", ("minari",), ("minari",), "the dataset's id, such as mujoco/hopper/medium-v0"),
    ):
        value, source = getattr(options, name), options.source
        if value is None and source in needed:
            raise UserError(f"download.source is {source!r} and download.{name} is null: give {what}.")
        if value is not None and source not in wanted:
            raise UserError(
                f"download.{name} is {value!r} and download.source is {source!r}, which has no use for it: set "
                f"download.source to {wanted[0]!r}, or download.{name} to null."
            )


def check_ranges(params: Params) -> None:
    """Types and ranges of parameters that a program has put together; those of files pass `build_params`.

    Raises:
        UserError: an option is of the wrong type or out of range.
    """
    _dataclass(Params, dataclasses.asdict(params), "")


def check_world_model(options: TrainModelOptions, section: str = "train_model") -> None:
    """The rules that tie the world model's options together; what an ensemble does not read may be anything.

    Args:
        options: of model and training.
        section: what errors call them.

    Raises:
        UserError: one is broken.
    """
    if options.ensemble is None:
        _check_model(f"{section}.model", options.model)
        _check_epochs(section, options)
    else:
        _check_epochs(f"{section}.ensemble", options.ensemble)
        _check_ensemble(f"{section}.ensemble", options.ensemble)


def check_policy(options: PolicyOptions, section: str) -> None:
    """The rules that tie a policy's options together, whether or not it imagines.

    Args:
        options: of the policy.
        section: what errors call them.

    Raises:
        UserError: one is broken.
    """
    _check_epochs(section, options)
    if options.updates_per_epoch % options.updates_per_step:
        raise UserError(
            f"{section}.updates_per_epoch is {options.updates_per_epoch}: take a multiple of updates_per_step "
            f"({options.updates_per_step})."
        )
    if options.warm_start > options.updates:
        raise UserError(
            f"{section}.warm_start is {options.warm_start}, more than its updates ({options.updates}): the warm start "
            "is a part of them."
        )


def check_no_imagination(options: PolicyOptions, section: str) -> None:
    """A policy that sees data alone has no section for imagination.

    Raises:
        UserError: it has one.
    """
    if options.imagination is not None:
        raise UserError(f"{section}.imagination must be null: this policy sees data alone, et_cql imagines.")


def _check_model(section: str, model: ModelOptions) -> None:
    if model.width % (2 * model.heads):
        raise UserError(
            f"{section}.width is {model.width} and heads is {model.heads}: each head needs an even share, so take a "
            f"width that is a multiple of {2 * model.heads}."
        )

    if model.objective == "paper_mse" and model.epistemic != "head":
        raise UserError(
            f"{section}.objective is paper_mse and epistemic is {model.epistemic}: that objective trains the paper's "
            "third head, so set epistemic to head."
        )


def _check_ensemble(section: str, options: EnsembleOptions) -> None:
    if options.elites > options.members:
        raise UserError(
            f"{section}.elites is {options.elites} and members is {options.members}: elites are chosen from the "
            "members, so take no more than those."
        )
    if len(options.weight_decay) != len(options.hidden) + 1:
        raise UserError(
            f"{section}.weight_decay has {len(options.weight_decay)} entries and there are {len(options.hidden) + 1} "
            "layers, the output layer among them: give one for each."
        )


def _check_policies(params: Params) -> None:
    policies = params.train_policy
    check_no_imagination(policies.cql, "train_policy.cql")
    if policies.et_cql.imagination is None:
        raise UserError(
            "train_policy.et_cql.imagination is null: give it a section, since train_policy.cql is without."
        )
    check_policy(policies.cql, "train_policy.cql")
    check_policy(policies.et_cql, "train_policy.et_cql")
    _check_imagination(policies.et_cql, policies.et_cql.imagination, params.train_model)


def _check_imagination(policy: PolicyOptions, imagination: ImaginationOptions, model: TrainModelOptions) -> None:
    section, climbing = "train_policy.et_cql.imagination", imagination.value_gradient
    _check_history(section, imagination.history, model)
    if climbing is None:
        return
    if climbing.horizon < imagination.history:
        raise UserError(
            f"{section}.value_gradient.horizon is {climbing.horizon} and history is {imagination.history}: rollouts "
            "carried on take their history from the steps before, so take a horizon of at least that."
        )
    if climbing.updates > policy.updates - policy.warm_start:
        raise UserError(
            f"{section}.value_gradient.updates is {climbing.updates}, and {policy.updates - policy.warm_start} updates "
            "come after the warm start: take no more than those."
        )


def _check_epistemic(params: Params) -> None:
    imagination, train = params.train_policy.et_cql.imagination, params.train_model
    assert imagination is not None
    for key, value in (
        ("generate_rollouts.novelty_limit", params.generate_rollouts.novelty_limit),
        ("train_policy.et_cql.imagination.novelty_limit", imagination.novelty_limit),
        ("train_policy.et_cql.imagination.posterior", imagination.posterior or None),
    ):
        drawn = key.endswith("posterior")
        lacking = _lacking(train, drawn=drawn)
        if value is not None and lacking is not None:
            raise UserError(f"{key} is {value} and {lacking}, or the first to {0 if drawn else 'null'}.")


def _lacking(options: TrainModelOptions, *, drawn: bool) -> str | None:
    """What leaves a world model without epistemic variance, or without a posterior to be drawn from, and the remedy."""
    ensemble, epistemic = options.ensemble, options.model.epistemic
    if ensemble is None:
        if epistemic == "laplace":
            return None
        return f"train_model.model.epistemic is {epistemic}, which has no posterior: set that to laplace"
    name = "elites" if drawn else "members"  # rollouts follow an elite; all members disagree
    if getattr(ensemble, name) > 1:
        return None
    return f"train_model.ensemble.{name} is 1, which has no other to differ from: set that to 2 or more"


def _check_epochs(section: str, options: TrainModelOptions | EnsembleOptions | PolicyOptions) -> None:
    if options.updates % options.updates_per_epoch:
        raise UserError(
            f"{section}.updates is {options.updates}: take a multiple of its updates_per_epoch "
            f"({options.updates_per_epoch})."
        )


def _check_history(section: str, history: int, options: TrainModelOptions) -> None:
    context = options.model.context
    if options.ensemble is None and history > context - 1:  # an ensemble takes any, and looks at the last step alone
        raise UserError(
            f"{section}.history is {history} and train_model.model.context is {context}: the model remembers at most "
            f"{context - 1} steps before the present one."
        )
