"""Soft Actor-Critic (Haarnoja et al. 2018): critics and their targets, a Gaussian actor, a learned temperature."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.agents.actor_critic import ActorCritic, held_fixed
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.phases import Batch, Logs, Part
from envtf_lit.options.numbers import NonNegative

INITIAL_ALPHA = 0.01  # weight of the entropy in the actor's objective at the start; learned from there on


@dataclass(frozen=True)
class SACOptions(PolicyOptions):
    """Soft Actor-Critic's own options.

    Attributes:
        clone_weight: weight in the actor's objective of cloning the real rows' actions, which keeps it near the log; of
            the mean over action dimensions. Published is 0.
    """

    clone_weight: NonNegative = 0.0


class Temperature(nn.Module):
    """`alpha`, the weight of the entropy, as its logarithm."""

    def __init__(self) -> None:
        super().__init__()
        self.log_alpha = nn.Parameter(torch.tensor(INITIAL_ALPHA).log())


class SAC(ActorCritic):
    """Soft Actor-Critic."""

    Options: ClassVar[type[PolicyOptions]] = SACOptions
    label = "SAC"
    options: SACOptions
    actor: TanhGaussianActor

    def build_networks(self) -> None:
        super().build_networks()
        self.temperature = Temperature()

    def parts(self) -> dict[str, Part]:
        o = self.options
        return dict(
            actor=Part(self.actor, o.actor_learning_rate),
            critics=Part(self.critics, o.critic_learning_rate),
            temperature=Part(self.temperature, o.actor_learning_rate),
        )

    def losses(self, batch: Batch) -> Iterator[tuple[str, Tensor, Logs]]:
        critic_loss, critic_logs = self.critic_loss(batch)
        yield "critics", critic_loss, critic_logs
        with held_fixed(self.critics):
            actor_loss, actor_logs = self.actor_loss(batch)
            yield "actor", actor_loss, actor_logs
        temperature_loss = self.temperature_loss(actor_logs["entropy"])
        yield "temperature", temperature_loss, {}

    def critic_loss(self, batch: Batch) -> tuple[Tensor, Logs]:
        """`1/2 (Q_i(s, a) - y)^2`, summed over critics (equation 5)."""
        with torch.no_grad():
            target = self.td_target(batch)
        q = self.critics(batch["observations"], batch["actions"])
        loss = 0.5 * (q - target).square().mean(1).sum()
        return loss, dict(bellman_loss=loss, q_data=q.mean(), q_target=target.mean())

    def td_target(self, batch: Batch) -> Tensor:
        """`r + gamma (1 - terminated) (min_i Q_i'(s', a') - alpha log pi(a'|s')), a' ~ pi(s')`; bootstraps truncations.

        With n-step transitions r is their discounted sum, gamma the discount of all n, s' where they end.
        """
        action, log_density = self.actor.sample(batch["next_observations"], generator=self.generator)
        following = self.target_critics(batch["next_observations"], action).min(0).values
        return batch["rewards"] + batch["discounts"] * (following - self.alpha * log_density)

    def actor_loss(self, batch: Batch) -> tuple[Tensor, Logs]:
        """`E[alpha log pi(a|s) - min_i Q_i(s, a)], a ~ pi(s)`, alpha held fixed, and `clone_weight * clone_loss`."""
        action, log_density = self.actor.sample(batch["observations"], generator=self.generator)
        q = self.critics(batch["observations"], action).min(0).values
        loss = (self.alpha * log_density - q).mean()
        logs = dict(q_policy=q.mean(), entropy=-log_density.mean())
        if self.options.clone_weight > 0:
            logs["clone_loss"] = self.clone_loss(batch)
            loss = loss + self.options.clone_weight * logs["clone_loss"]
        return loss, logs

    def temperature_loss(self, entropy: Tensor) -> Tensor:
        """`alpha (H - H_target)`, H_target = -A (equation 18)."""
        return self.temperature.log_alpha.exp() * (entropy.detach() + self.action_dim)

    @property
    def alpha(self) -> Tensor:
        """The entropy's weight, without gradient."""
        return self.temperature.log_alpha.detach().exp()
