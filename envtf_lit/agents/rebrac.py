"""ReBRAC (Tarasov et al. 2023): TD3+BC with a penalty of its own in the critics' targets, LayerNorm, large batches."""

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.phases import Batch, Logs
from envtf_lit.agents.td3_bc import TD3, TD3Options
from envtf_lit.options.numbers import NonNegative


@dataclass(frozen=True)
class ReBRACOptions(TD3Options):
    """ReBRAC's own options; its batches of 1,024, rates of .001 and LayerNorm are common options (configs/algorithms).

    Attributes:
        actor_penalty: beta_1, of the squared distance to the recorded actions in the actor's loss.
        critic_penalty: beta_2, of the squared distance to the recorded next actions in the critics' targets.
    """

    actor_penalty: NonNegative = 0.01
    critic_penalty: NonNegative = 0.01


class ReBRAC(TD3):
    """TD3 whose actor and critics both pay for leaving the recorded actions."""

    Options: ClassVar[type[PolicyOptions]] = ReBRACOptions
    label = "ReBRAC"
    options: ReBRACOptions

    def td_target(self, batch: Batch) -> Tensor:
        """`y = r + gamma (min_i Q_i'(s', a') - beta_2 |a' - a'_data|^2)` (equation 4), a' of the noisy target actor.

        Where an episode ends, no next action was recorded, and nothing is paid.
        """
        action = self.noisy_target(batch["next_observations"])
        following = self.target_critics(batch["next_observations"], action).min(0).values
        paid = batch["followed"] * self.squared_distance(action, batch["next_actions"])
        return batch["rewards"] + batch["discounts"] * (following - self.options.critic_penalty * paid)

    def actor_loss(self, batch: Batch) -> tuple[Tensor, Logs]:
        """`beta_1 |pi(s) - a|^2 - lambda min_i Q_i(s, pi(s))`, `lambda = 1 / mean |Q|` held fixed (equation 3)."""
        action = self.actor(batch["observations"])
        q = self.critics(batch["observations"], action).min(0).values
        weight = 1.0 / q.abs().mean().clamp(min=1e-6).detach()
        distance = self.squared_distance(action, batch["actions"]).mean()
        loss = self.options.actor_penalty * distance - weight * q.mean()
        return loss, dict(q_policy=q.mean(), clone_loss=distance / self.action_dim)

    def squared_distance(self, action: Tensor, recorded: Tensor) -> Tensor:
        """(B,) of actions (B, A), summed over dimensions as published, in shares of the range from -1 to 1."""
        return (self.actor.squashed(action) - self.actor.squashed(recorded)).square().sum(-1)
