"""COMBO's conservative term (Yu et al. 2021): down on real and imagined rows alike, up on real rows alone."""

from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

from torch import Tensor

from envtf_lit.agents.cql import CQL, CQLOptions
from envtf_lit.agents.model_based import BranchedRolloutOptions
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.imagination.options import RolloutOptions
from envtf_lit.options.numbers import Count, Natural, NonNegative, NonzeroShare
from envtf_lit.options.schema import rare


@dataclass(frozen=True)
class MixingOptions(PolicyOptions):
    """Options of policies that learn from imagined rows in a transformer, too.

    Attributes:
        real_ratio: share of real rows in each batch, in (0, 1].
        refresh_every: updates between two rounds of new rollouts under the current policy; 0 keeps the stored ones
            (the paper's fixed buffer).
        rollouts: the imagined rollouts.
    """

    world_model: str = "transformer"

    real_ratio: NonzeroShare = 0.75
    refresh_every: Natural = 250
    rollouts: RolloutOptions = field(default_factory=RolloutOptions)

    @property
    def path_lengths(self) -> dict[str, int]:
        """Steps through the world model, by option."""
        return {"rollouts.value_expansion": self.rollouts.value_expansion}

    def within(self, reach: int) -> Self:
        """The same, with no path through the world model longer than `reach` steps, as far as that can be.

        Rollouts keep their horizon, which is what is learned from; their value expansion is cut.
        """
        o = self.rollouts
        expansion = max(0, min(o.value_expansion, reach - o.horizon))
        return replace(self, rollouts=replace(o, value_expansion=expansion))


@dataclass(frozen=True)
class ImaginingOptions(MixingOptions, CQLOptions):
    """Options of conservative soft actor-critic on real and imagined rows."""


@dataclass(frozen=True)
class COMBOOptions(ImaginingOptions):
    """COMBO's published settings: in the ensemble, half of each batch real, each imagined step a row of its own.

    With `world_model: transformer` it is the Environment Transformer's COMBO: an option, not another algorithm.
    """

    world_model: str = "ensemble"
    cql_weight: NonNegative = 5.0
    sampled_actions: Count = rare(10)
    clone_weight: NonNegative = 0.0

    real_ratio: NonzeroShare = 0.5
    refresh_every: Natural = 1_000
    rollouts: BranchedRolloutOptions = field(default_factory=BranchedRolloutOptions)


class COMBO(CQL):
    """Conservative Q-Learning on a mixture of real and imagined rows, in COMBO's form, in any world model."""

    Options: ClassVar[type[PolicyOptions]] = COMBOOptions
    label = "COMBO"
    imagines = True
    options: ImaginingOptions

    def conservative_gap(self, q_data: Tensor, q_proposed: Tensor, log_density: Tensor, real: Tensor) -> Tensor:
        """(n,) the soft maximum of Q over all rows, less Q of the real rows' actions (equation 3).

        To push up on imagined rows, too, would reward the policy's own imagined actions.
        """
        return self.pushed_down(q_proposed, log_density).mean(1) - (q_data * real).sum(1) / real.sum()
