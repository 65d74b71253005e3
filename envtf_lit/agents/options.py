"""The options of policies and of their training."""

from dataclasses import dataclass, field
from typing import Literal

from envtf_lit.errors import UserError
from envtf_lit.imagination.options import ImaginationOptions
from envtf_lit.options.schema import check_epochs


@dataclass(frozen=True)
class PolicyOptions:
    """Conservative Q-Learning (Kumar et al. 2020) on data, or on data and imagination.

    Attributes:
        updates: gradient steps in all, the warm start included.
        updates_per_epoch: gradient steps between two log lines (and resumable checkpoints).
        updates_per_step: gradient steps per Lightning training step.
        batch_size: rows per gradient step.
        hidden: units of each hidden layer of actor and critics.
        critics: Q-functions, of which the target takes the smallest.
        layer_norm: LayerNorm in the critics.
        discount: of future rewards, per step.
        normalise_returns: divides rewards by the standard deviation of the log's Monte-Carlo returns, so that Q has
            unit spread on any robot and the other weights mean the same everywhere.
        return_temperature: real rows are drawn with chances exp(episode return / temperature), returns scaled to
            [0, 1], so that a mostly poor log teaches what its best episodes did; null draws uniformly.
        n_step: real steps whose rewards enter the temporal-difference target.
        target_rate: share of the critics that enters the target networks at each update.
        actor_learning_rate: Adam's.
        actor_schedule: of the actor's learning rate after the warm start: `constant`, or half a cosine to zero.
        critic_learning_rate: Adam's.
        cql_weight: weight of the conservative term.
        initial_alpha: weight of the entropy in the actor's objective at the start; learned from there on.
        clone_weight: weight in the actor's objective of cloning the real rows' actions, which keeps it near the log.
        sampled_actions: actions of each kind (uniform, pi(s), pi(s')) in the log-sum-exp.
        temperature: of the log-sum-exp.
        warm_start: first updates, in which the critics fit Monte-Carlo returns and the actor clones the data.
        warm_start_learning_rate: Adam's, of both, during the warm start.
        actor_average: share of the actor that enters the averaged actor at each update; the average is what is saved.
        imagination: None trains on data alone.
    """

    updates: int = 4_500
    updates_per_epoch: int = 500
    updates_per_step: int = 10
    batch_size: int = 256
    hidden: tuple[int, ...] = (256, 256)
    critics: int = 2
    layer_norm: bool = True
    discount: float = 0.997
    normalise_returns: bool = True
    return_temperature: float | None = 0.1
    n_step: int = 20
    target_rate: float = 0.005
    actor_learning_rate: float = 0.0003
    actor_schedule: Literal["constant", "cosine"] = "cosine"
    critic_learning_rate: float = 0.0003
    cql_weight: float = 0.1
    initial_alpha: float = 0.01
    clone_weight: float = 0.25
    sampled_actions: int = 2
    temperature: float = 1.0
    warm_start: int = 1_500
    warm_start_learning_rate: float = 0.001
    actor_average: float = 0.002
    imagination: ImaginationOptions | None = None


@dataclass(frozen=True)
class TrainPolicyOptions:
    """The two policies that are compared, with equal budgets.

    Attributes:
        cql: data alone.
        et_cql: data and imagination.
    """

    cql: PolicyOptions = field(default_factory=PolicyOptions)
    et_cql: PolicyOptions = field(default_factory=lambda: PolicyOptions(imagination=ImaginationOptions()))


def check_policy(options: PolicyOptions, section: str) -> None:
    """The rules that tie a policy's options together, whether or not it imagines.

    Args:
        options: of the policy.
        section: what errors call them.

    Raises:
        UserError: one is broken.
    """
    check_epochs(section, options)
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
