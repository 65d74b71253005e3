"""The options that all policies share; an algorithm's own stand in its file."""

from dataclasses import dataclass
from typing import Literal

from envtf_lit.data.options import UPDATES_PER_STEP
from envtf_lit.errors import UserError
from envtf_lit.options.numbers import Count, NonNegative, NonzeroShare, Positive, Share
from envtf_lit.options.schema import check_epochs, rare

NO_WORLD_MODEL = "none"


@dataclass(frozen=True)
class CommonOptions:
    """What all policies share, so that they are compared with equal budgets, networks and rows.

    Attributes:
        updates: gradient steps in all, the warm start included; a multiple of `updates_per_epoch`.
        updates_per_epoch: gradient steps between two log lines and resumable checkpoints, a multiple of 10.
        batch_size: rows per gradient step.
        hidden: units of each hidden layer of actor and critics.
        layer_norm: LayerNorm in the critics.
        discount: of future rewards, per step.
        normalise_returns: divides rewards by the standard deviation of the log's Monte-Carlo returns, truncated
            episodes going on as rows do on average, so that Q has unit spread on any robot and the other weights mean
            the same everywhere.
        return_temperature: real rows are drawn with chances exp(episode return / temperature), returns scaled to
            [0, 1], so that a mostly poor log teaches what its best episodes did; null draws uniformly.
        fewest_episodes: the temperature is raised until rows come from at least so many episodes, each counted by its
            share of the rows (their effective number), or from as many as uniform draws do.
        n_step: real steps whose rewards enter the temporal-difference target.
        target_rate: share of the critics that enters the target networks at each update.
        actor_learning_rate: Adam's.
        actor_schedule: of the actor's learning rate after the warm start: `constant`, or half a cosine to zero.
        critic_learning_rate: Adam's.
        warm_start: share of the updates, the first ones, in which critics fit Monte-Carlo returns and the actor clones
            the data, for algorithms that have both; from 1 on their number, at most all.
        actor_average: share of the actor that enters the averaged actor at each update; the average is what is saved.
    """

    updates: Count = 4_500
    updates_per_epoch: Count = 500
    batch_size: Count = 256
    hidden: tuple[Count, ...] = (256, 256)
    layer_norm: bool = rare(True)
    discount: Share = 0.997
    normalise_returns: bool = True
    return_temperature: Positive | None = 0.1
    fewest_episodes: Count = rare(20)
    n_step: Count = 20
    target_rate: NonzeroShare = rare(0.005)
    actor_learning_rate: Positive = 0.0003
    actor_schedule: Literal["constant", "cosine"] = rare("cosine")
    critic_learning_rate: Positive = 0.0003
    warm_start: NonNegative = 0.3333
    actor_average: NonzeroShare = 0.002

    def __post_init__(self) -> None:
        check_epochs(self)
        if self.updates_per_epoch % UPDATES_PER_STEP:
            raise UserError(f"updates_per_epoch is {self.updates_per_epoch}: take a multiple of {UPDATES_PER_STEP}.")

    @property
    def warm_updates(self) -> int:
        """Updates of the warm start."""
        return min(self.updates, round(self.warm_start * (self.updates if self.warm_start < 1 else 1)))


@dataclass(frozen=True)
class PolicyOptions(CommonOptions):
    """The options of any one policy.

    Attributes:
        world_model: the section below `train_model` whose model it imagines in; `none` learns from data alone.
    """

    world_model: str = NO_WORLD_MODEL
