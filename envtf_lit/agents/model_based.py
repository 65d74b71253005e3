"""What MOPO, RAMBO and MOBILE share: soft actor-critic on real and imagined rows (MBPO, Janner et al. 2019)."""

from dataclasses import dataclass, field

from envtf_lit.agents.sac import SAC, SACOptions
from envtf_lit.imagination.buffer import ImaginedBatches
from envtf_lit.imagination.options import RolloutOptions
from envtf_lit.options.numbers import Count, Natural, NonNegative, NonzeroShare, Positive


@dataclass(frozen=True)
class BranchedRolloutOptions(RolloutOptions):
    """Published rollouts: many short ones, each step a row of its own, whatever the model knows of its errors."""

    branches: Count = 50_000
    horizon: Count = 5
    value_expansion: Natural = 0
    posterior: NonNegative = 0.0
    novelty_limit: Positive | None = None


@dataclass(frozen=True)
class ModelBasedOptions(SACOptions):
    """Options of soft actor-critic that learns from imagined rows, too.

    Attributes:
        real_ratio: share of real rows in each batch, in (0, 1].
        refresh_every: updates between two rounds of new rollouts under the current policy; 0 keeps the stored ones.
        rollouts: the imagined rollouts.
    """

    world_model: str = "ensemble"

    real_ratio: NonzeroShare = 0.05
    refresh_every: Natural = 1_000
    rollouts: BranchedRolloutOptions = field(default_factory=BranchedRolloutOptions)


class ModelBased(SAC):
    """Soft actor-critic on real and imagined rows."""

    imagines = True
    options: ModelBasedOptions
    source: ImaginedBatches
