"""The schema of `params.yaml`: every option of every stage, and the rules that tie options of several stages."""

import dataclasses
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from envtf_lit.agents.options import NO_WORLD_MODEL, CommonOptions, PolicyOptions
from envtf_lit.data.options import DownloadOptions, check_download
from envtf_lit.errors import UserError, did_you_mean
from envtf_lit.imagination.options import GenerateRolloutsOptions, RolloutOptions
from envtf_lit.options.numbers import Count, Frames, Natural
from envtf_lit.options.schema import Precision, build, build_tagged
from envtf_lit.robots.tasks import get_task
from envtf_lit.world_models.options import KINDS, EnsembleOptions, TransformerOptions, WorldModelOptions

if TYPE_CHECKING:
    from envtf_lit.agents.agent import Agent

NAME = re.compile(r"[A-Za-z0-9][\w-]*")  # of world models and policies: they name folders
COMMON = tuple(f.name for f in dataclasses.fields(CommonOptions))


def algorithms() -> dict[str, type["Agent"]]:
    """The registry, imported when it is asked for: torch comes with it, which most stages' `--help` does without."""
    from envtf_lit.agents.registry import ALGORITHMS

    return ALGORITHMS


@dataclass(frozen=True)
class EvaluateOptions:
    """The evidence.

    Attributes:
        world_model: the section below `train_model` whose model is scored and filmed.
        episodes: MuJoCo episodes per policy, seeded `seed + 1000 + i`.
        trajectories: held-out episodes on which the world model is scored over long horizons.
        video_frames: frames of the real-versus-imagined video, at most 150.
    """

    world_model: str = "transformer"
    episodes: Count = 20
    trajectories: Count = 50
    video_frames: Frames = 150


def _default_models() -> dict[str, WorldModelOptions]:
    return {"transformer": TransformerOptions()}


def _default_policies() -> dict[str, PolicyOptions]:
    chosen = {"bc": {"return_temperature": None}, "cql": {}, "et_cql": {"world_model": "transformer"}}
    return {name: algorithms()[name].Options(**options) for name, options in chosen.items()}


@dataclass(frozen=True)
class Params:
    """All of `params.yaml`.

    Attributes:
        task: robot and tier, such as `hopper-medium-replay`, or null for a robot of your own.
        seed: of everything random.
        threads: CPU threads of each stage; part of what makes results equal to the bit.
        precision: of matrix products in training and imagination; losses and optimisers stay in fp32. `auto` is bf16
            where the device multiplies it natively, else fp32: numbers differ between such machines, so write which one
            to repeat another's.
        compile: world models train and imagine through torch.compile, which takes a minute to begin with: pays on a
            GPU, where launching their many small operations is what takes the time.
        download: the dataset.
        train_model: world models by name; `kind` is transformer or ensemble.
        generate_rollouts: the first imagined rollouts in each world model.
        policy: what all policies share, unless a policy's own section says otherwise.
        train_policy: policies by name, each with its `algorithm` and its `world_model`; a further section is trained,
            evaluated and reported, too.
        evaluate: the evidence.
    """

    task: str | None = "hopper-medium-replay"
    seed: Natural = 0
    threads: Count = 2
    precision: Precision = "auto"
    compile: bool = False
    download: DownloadOptions = field(default_factory=DownloadOptions)
    train_model: dict[str, WorldModelOptions] = field(default_factory=_default_models)
    generate_rollouts: GenerateRolloutsOptions = field(default_factory=GenerateRolloutsOptions)
    policy: CommonOptions = field(default_factory=CommonOptions)
    train_policy: dict[str, PolicyOptions] = field(default_factory=_default_policies)
    evaluate: EvaluateOptions = field(default_factory=EvaluateOptions)


def build_params(values: Mapping[str, Any]) -> Params:
    """The options in a tree of plain values; what is absent takes its default.

    Raises:
        UserError: an unknown option (with the nearest known one), a value of the wrong type or out of range, or two
            options that contradict each other.
    """
    tree = dict(values)
    named = {name: tree.pop(name) for name in ("train_model", "train_policy") if name in tree}
    sections = {name: build(type_, tree.pop(name), name) for name, type_ in _sections() if name in tree}
    params = dataclasses.replace(build(Params, tree, ""), **sections)
    if params.download.path is not None:  # no shell does it for a file's `~`
        own = dataclasses.replace(params.download, path=os.path.expanduser(params.download.path))
        params = dataclasses.replace(params, download=own)
    if "train_model" in named:
        models = {name: build_tagged(KINDS, "kind", item, key) for name, key, item in _named("train_model", named)}
        params = dataclasses.replace(params, train_model=models)
    if "train_policy" in named:
        params = dataclasses.replace(params, train_policy=dict(_policies(params.policy, named)))
    check_rules(params)
    return params


def _sections() -> list[tuple[str, type]]:
    """The plain sections and their classes."""
    return [
        ("download", DownloadOptions),
        ("generate_rollouts", GenerateRolloutsOptions),
        ("policy", CommonOptions),
        ("evaluate", EvaluateOptions),
    ]


def _named(stage: str, sections: Mapping[str, Any]) -> Iterator[tuple[str, str, Any]]:
    """(name, key, values) of each section below a stage."""
    below = sections[stage]
    if not isinstance(below, Mapping) or not below:
        raise UserError(f"{stage} is {below!r}, expected one section or more, each with a name of its own.")
    for name, values in below.items():
        if not NAME.fullmatch(str(name)) or name == NO_WORLD_MODEL:
            raise UserError(f"{stage} has a section {name!r}: name it with letters, digits, _ and -, and not 'none'.")
        yield str(name), f"{stage}.{name}", values


def _policies(common: CommonOptions, sections: Mapping[str, Any]) -> Iterator[tuple[str, PolicyOptions]]:
    """Each policy's own options over what all share."""
    classes = {name: algorithm.Options for name, algorithm in algorithms().items()}
    shared = dataclasses.asdict(common)
    for name, key, values in _named("train_policy", sections):
        whole = {**shared, **values} if isinstance(values, Mapping) else values
        yield name, build_tagged(classes, "algorithm", whole, key)


def algorithm_of(options: PolicyOptions) -> str:
    """The name of the algorithm that has these options.

    Raises:
        UserError: several have them.
    """
    found = [name for name, algorithm in algorithms().items() if algorithm.Options is type(options)]
    if len(found) > 1:  # one would be trained in place of the other
        raise UserError(f"{' and '.join(found)} have {type(options).__name__} in common: give each options of its own.")
    return found[0]


def kind_of(options: WorldModelOptions) -> str:
    """The name of the kind of world model that has these options."""
    return next(name for name, cls in KINDS.items() if cls is type(options))


def one_of(stage: str, sections: Mapping[str, Any], name: str | None) -> str:
    """The name of a section below a stage: the one asked for, or the only one.

    Raises:
        UserError: there is no such section, or there are several and none is named.
    """
    if name is None:
        if len(sections) == 1:
            return next(iter(sections))
        raise UserError(f"{stage} has the sections {', '.join(sections)}: name one of them.")
    if name not in sections:
        raise UserError(f"There is no section {name!r} below {stage}: {did_you_mean(name, sections)}")
    return name


def check_rules(params: Params) -> None:
    """The rules that tie options of several sections together.

    Raises:
        UserError: one is broken; the sentence names the options in conflict.
    """
    if params.task is not None:
        get_task(params.task)
    check_download(params.download, named=params.task is not None)
    first = params.generate_rollouts
    for name, model in params.train_model.items():
        _check_history("generate_rollouts", first.history, name, model)
        _check_epistemic("generate_rollouts.novelty_limit", first.novelty_limit, name, model)
    one_of("train_model", params.train_model, params.evaluate.world_model)
    for name, policy in params.train_policy.items():
        _check_policy(f"train_policy.{name}", policy, params)
    one_of("train_policy", params.train_policy, first.policy)
    if params.train_policy[first.policy].world_model != NO_WORLD_MODEL:
        raise UserError(
            f"generate_rollouts.policy is {first.policy}, which itself learns from imagined rollouts: name one from "
            "data alone, such as bc."
        )


def _check_policy(section: str, options: PolicyOptions, params: Params) -> None:
    algorithm = algorithm_of(options)
    model = options.world_model
    if not algorithms()[algorithm].imagines:
        if model != NO_WORLD_MODEL:
            raise UserError(
                f"{section}.world_model is {model}, and {algorithm} learns from data alone: set it to none."
            )
        return
    if model == NO_WORLD_MODEL:
        raise UserError(
            f"{section}.world_model is none, and {algorithm} imagines: name a section below train_model, such as "
            f"{next(iter(params.train_model))}."
        )
    if model not in params.train_model:
        raise UserError(f"{section}.world_model is {model!r}: {did_you_mean(model, params.train_model)}")
    rollouts: RolloutOptions = options.rollouts  # pyright: ignore[reportAttributeAccessIssue]
    trained = params.train_model[model]
    _check_history(f"{section}.rollouts", rollouts.history, model, trained)
    _check_epistemic(f"{section}.rollouts.novelty_limit", rollouts.novelty_limit, model, trained)
    _check_epistemic(f"{section}.rollouts.posterior", rollouts.posterior or None, model, trained)


def _check_epistemic(key: str, value: float | None, name: str, model: WorldModelOptions) -> None:
    drawn = key.endswith("posterior")
    lacking = _lacking(f"train_model.{name}", model, drawn=drawn)
    if value is not None and lacking is not None:
        raise UserError(f"{key} is {value} and {lacking}, or the first to {0 if drawn else 'null'}.")


def _lacking(section: str, options: WorldModelOptions, *, drawn: bool) -> str | None:
    """What leaves a world model without epistemic variance, or without a posterior to be drawn from, and the remedy."""
    if isinstance(options, TransformerOptions):
        if options.epistemic == "laplace":
            return None
        return f"{section}.epistemic is {options.epistemic}, which has no posterior: set that to laplace"
    name = "elites" if drawn else "members"  # rollouts follow an elite; all members disagree
    if getattr(options, name) > 1:
        return None
    return f"{section}.{name} is 1, which has no other to differ from: set that to 2 or more"


def _check_history(section: str, history: int, name: str, model: WorldModelOptions) -> None:
    if isinstance(model, EnsembleOptions):  # takes any, and looks at the last step alone
        return
    if history > model.context - 1:
        raise UserError(
            f"{section}.history is {history} and train_model.{name}.context is {model.context}: the model remembers at "
            f"most {model.context - 1} steps before the present one."
        )
