"""The schema of `params.yaml`: every option of every stage, and the rules that tie options together."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from envtf_lit.agents.options import PolicyOptions, TrainPolicyOptions, check_no_imagination, check_policy
from envtf_lit.data.options import DownloadOptions, check_download
from envtf_lit.errors import UserError
from envtf_lit.imagination.options import GenerateRolloutsOptions, ImaginationOptions
from envtf_lit.options.schema import Precision, build
from envtf_lit.robots.tasks import get_task
from envtf_lit.world_models.options import TrainModelOptions, check_world_model


@dataclass(frozen=True)
class EvaluateOptions:
    """The evidence.

    Attributes:
        episodes: MuJoCo episodes per policy, seeded `seed + 1000 + i`.
        trajectories: held-out episodes on which the world model is scored over long horizons.
        video_frames: frames of the real-versus-imagined video, at most 150.
    """

    episodes: int = 20
    trajectories: int = 50
    video_frames: int = 150


@dataclass(frozen=True)
class Params:
    """All of `params.yaml`.

    Attributes:
        task: robot and tier, such as `hopper-medium-replay`, or null for a robot of your own.
        seed: of everything random.
        threads: CPU threads of each stage; part of what makes results equal to the bit.
        precision: of matrix products in training and imagination; losses and optimisers stay in fp32.
        compile: world models train and imagine through torch.compile, which takes a minute to begin with: pays on a
            GPU, where launching their many small operations is what takes the time.
        download: the dataset.
        train_model: the world model.
        generate_rollouts: the behaviour clone and its imagined rollouts.
        train_policy: the policies.
        evaluate: the evidence.
    """

    task: str | None = "hopper-medium-replay"
    seed: int = 0
    threads: int = 2
    precision: Precision = "bf16"
    compile: bool = False
    download: DownloadOptions = field(default_factory=DownloadOptions)
    train_model: TrainModelOptions = field(default_factory=TrainModelOptions)
    generate_rollouts: GenerateRolloutsOptions = field(default_factory=GenerateRolloutsOptions)
    train_policy: TrainPolicyOptions = field(default_factory=TrainPolicyOptions)
    evaluate: EvaluateOptions = field(default_factory=EvaluateOptions)


def build_params(values: Mapping[str, Any]) -> Params:
    """The options in a tree of plain values; what is absent takes its default.

    Raises:
        UserError: an unknown option (with the nearest known one), a value of the wrong type or out of range, or two
            options that contradict each other.
    """
    params = build(Params, values, "")
    check_rules(params)
    return params


def check_rules(params: Params) -> None:
    """The rules that tie options together.

    Raises:
        UserError: one is broken; the sentence names the options in conflict.
    """
    if params.task is not None:
        get_task(params.task)
    check_download(params.download, named=params.task is not None)
    check_world_model(params.train_model)
    _check_policies(params)
    _check_epistemic(params)
    _check_history("generate_rollouts", params.generate_rollouts.history, params.train_model)


def check_ranges(params: Params) -> None:
    """Types and ranges of parameters that a program has put together; those of files pass `build_params`.

    Raises:
        UserError: an option is of the wrong type or out of range.
    """
    build(Params, dataclasses.asdict(params), "")


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


def _check_history(section: str, history: int, options: TrainModelOptions) -> None:
    context = options.model.context
    if options.ensemble is None and history > context - 1:  # an ensemble takes any, and looks at the last step alone
        raise UserError(
            f"{section}.history is {history} and train_model.model.context is {context}: the model remembers at most "
            f"{context - 1} steps before the present one."
        )
