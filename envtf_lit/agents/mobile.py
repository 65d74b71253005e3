"""MOBILE (Sun et al. 2023): targets of imagined rows pay for what worlds disagree on, the value of the next state."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from envtf_lit.agents.model_based import ModelBased, ModelBasedOptions
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.phases import Batch
from envtf_lit.options.numbers import Count, NonNegative
from envtf_lit.world_models.observed import bare
from envtf_lit.world_models.uncertainty.members import check_members, member_predictions


@dataclass(frozen=True)
class MOBILEOptions(ModelBasedOptions):
    """MOBILE's own options.

    Attributes:
        bellman_penalty: beta, weight of the worlds' disagreement in the targets of imagined rows.
        value_samples: next states drawn from each world.
    """

    bellman_penalty: NonNegative = 0.5
    value_samples: Count = 10


class MOBILE(ModelBased):
    """Soft actor-critic on real and imagined rows, with model-Bellman inconsistency as the penalty."""

    Options: ClassVar[type[PolicyOptions]] = MOBILEOptions
    label = "MOBILE"
    options: MOBILEOptions

    def build_networks(self) -> None:
        super().build_networks()
        check_members(bare(self.source.imagination.model))

    @torch.no_grad()
    def td_target(self, batch: Batch) -> Tensor:
        """`y = r + gamma min_i Q_i'(s', a') - beta U(s, a)`, U = 0 on real rows (equation 9); without entropy.

        Targets may be negative: the published code cuts them at zero, which suits rewards that are never below it.
        """
        action, _ = self.actor.sample(batch["next_observations"], generator=self.generator)
        following = self.target_critics(batch["next_observations"], action).min(0).values
        paid = (1.0 - batch["real"]) * self.inconsistency(batch["observations"], batch["actions"])
        return batch["rewards"] + batch["discounts"] * following - self.options.bellman_penalty * paid

    def inconsistency(self, observation: Tensor, action: Tensor) -> Tensor:
        """(B,) `U = std_m mean_n min_i Q_i'(s_mn, a_mn)`, s_mn drawn from world m, a_mn ~ pi(s_mn) (equation 7).

        All worlds draw with the same numbers, so that they differ in nothing but themselves: identical ones give 0.
        """
        N = self.options.value_samples
        with torch.autocast(observation.device.type, enabled=False):
            model = bare(self.source.imagination.model)
            means, stds = member_predictions(model, observation, action, generator=self.generator)
        _, B, S = means.shape
        noise = torch.randn(N, B, S, generator=self.generator, device=means.device)
        drawn, values = self.generator.get_state(), []
        for mean, std in zip(means, stds, strict=True):
            self.generator.set_state(drawn)
            states = (mean + std * noise).flatten(0, 1)  # (N * B, S)
            actions, _ = self.actor.sample(states, generator=self.generator)
            values.append(self.target_critics(states, actions).min(0).values.view(N, B).mean(0))
        return torch.stack(values).std(0)
