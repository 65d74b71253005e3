"""MOPO (Yu et al. 2020): imagined rewards pay for the model's uncertainty; without a penalty it is MBPO."""

from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from envtf_lit.agents.model_based import BranchedRolloutOptions, ModelBased, ModelBasedOptions
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.imagination.rollouts import Rollouts
from envtf_lit.options.numbers import NonNegative
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.observed import bare

ROWS = 4_096  # whose uncertainty is computed at a time


@dataclass(frozen=True)
class MOPORolloutOptions(BranchedRolloutOptions):
    """MOPO's rollouts.

    Attributes:
        penalty: lambda, weight of the uncertainty u in `r - lambda u`. Of an ensemble u is as published; of another
            world model it is that model's own, in units of the data's reward standard deviation, to which no published
            lambda applies. 0 is MBPO.
    """

    penalty: NonNegative = 1.0


@dataclass(frozen=True)
class MOPOOptions(ModelBasedOptions):
    """MOPO has the options of all that imagine; its lambda is `rollouts.penalty`."""

    rollouts: MOPORolloutOptions = field(default_factory=MOPORolloutOptions)


class MOPO(ModelBased):
    """Soft actor-critic on real rows and on imagined ones, whose rewards are penalised."""

    Options: ClassVar[type[PolicyOptions]] = MOPOOptions
    label = "MOPO"
    options: MOPOOptions

    def build_networks(self) -> None:
        super().build_networks()
        if isinstance(bare(self.source.imagination.model), EnsembleDynamics):  # others have a u of their own
            self.source.imagination.charged = self.charged

    def charged(self, rollouts: Rollouts) -> Tensor:
        """(H, B) `r - lambda u(s, a)`, u the largest norm of a member's standard deviation (section 4.3).

        The norm is over next state and reward in raw units, the maximum over all members.
        """
        imagination, taken = self.source.imagination, rollouts.valid
        model = bare(imagination.model)
        assert isinstance(model, EnsembleDynamics)
        if imagination.options.penalty == 0:
            return rollouts.rewards
        pairs = zip(rollouts.observations[taken].split(ROWS), rollouts.actions[taken].split(ROWS), strict=True)
        with torch.autocast(rollouts.rewards.device.type, enabled=False):
            u = torch.cat([model.largest_deviation(*some) for some in pairs])
        rewards = rollouts.rewards.clone()
        rewards[taken] -= imagination.options.penalty * u
        return rewards
