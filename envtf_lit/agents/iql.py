"""Implicit Q-Learning (Kostrikov et al. 2021): the value of the best recorded actions, and their imitation."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from envtf_lit.actors import Actor, GaussianActor
from envtf_lit.agents.actor_critic import ActorCritic
from envtf_lit.agents.networks import PlainStateValue
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.phases import Batch, Logs, Part
from envtf_lit.data.datamodules import TransitionData
from envtf_lit.options.numbers import InnerShare, Positive

LARGEST_WEIGHT = 100.0  # of a row in the actor's loss


@dataclass(frozen=True)
class IQLOptions(PolicyOptions):
    """Implicit Q-Learning's own options.

    Attributes:
        expectile: tau, of Q over the recorded actions, that the state value learns: 0.5 is their mean.
        beta: by which advantages are multiplied in the weights exp(beta A) of imitation; 0 would be cloning.
        return_range: rewards are scaled so that the log's episode returns differ by at most this (published: 1000), in
            place of `normalise_returns`; null leaves it to that.
    """

    expectile: InnerShare = 0.7
    beta: Positive = 3.0
    return_range: Positive | None = None


class IQL(ActorCritic):
    """Learns Q from recorded actions alone, and imitates those that do better than their state's value."""

    Options: ClassVar[type[PolicyOptions]] = IQLOptions
    label = "IQL"
    actor_kind: ClassVar[type[Actor]] = GaussianActor
    actor: GaussianActor
    options: IQLOptions

    def build_networks(self) -> None:
        super().build_networks()
        o = self.options
        self.value = PlainStateValue(self.observation_dim, hidden=o.hidden, layer_norm=o.layer_norm)

    def setup(self, stage: str) -> None:
        super().setup(stage)
        if self.options.return_range is not None:
            data: TransitionData = self.trainer.datamodule  # pyright: ignore[reportAttributeAccessIssue]
            returns = data.dataset.episode_returns
            self.return_scale.fill_(float(max(returns.max() - returns.min(), 1e-6)) / self.options.return_range)

    def parts(self) -> dict[str, Part]:
        o = self.options
        return dict(
            value=Part(self.value, o.critic_learning_rate),
            actor=Part(self.actor, o.actor_learning_rate),
            critics=Part(self.critics, o.critic_learning_rate),
        )

    def losses(self, batch: Batch) -> Iterator[tuple[str, Tensor, Logs]]:
        with torch.no_grad():
            q = self.target_critics(batch["observations"], batch["actions"]).min(0).values
        yield "value", *self.value_loss(batch, q)
        yield "actor", *self.actor_loss(batch, q)
        yield "critics", *self.critic_loss(batch)

    def value_loss(self, batch: Batch, q: Tensor) -> tuple[Tensor, Logs]:
        """`|tau - 1(u < 0)| u^2`, `u = Q'(s, a) - V(s)` (equation 5)."""
        value = self.value(batch["observations"])
        loss = expectile_loss(q - value, self.options.expectile).mean()
        return loss, dict(value_loss=loss, value=value.mean())

    def critic_loss(self, batch: Batch) -> tuple[Tensor, Logs]:
        """`(r + gamma V(s') - Q_i(s, a))^2`, summed over critics (equation 6)."""
        with torch.no_grad():
            target = batch["rewards"] + batch["discounts"] * self.value(batch["next_observations"])
        q = self.critics(batch["observations"], batch["actions"])
        loss = (q - target).square().mean(1).sum()
        return loss, dict(bellman_loss=loss, q_data=q.mean(), q_target=target.mean())

    def actor_loss(self, batch: Batch, q: Tensor) -> tuple[Tensor, Logs]:
        """`-min(exp(beta (Q'(s, a) - V(s))), 100) log pi(a|s)` (equation 7)."""
        with torch.no_grad():
            weight = torch.exp(self.options.beta * (q - self.value(batch["observations"]))).clamp(max=LARGEST_WEIGHT)
        loss = -(weight * self.actor.log_prob(batch["observations"], batch["actions"])).mean()
        return loss, dict(actor_loss=loss, weight=weight.mean())

    def warm_start_losses(self, batch: Batch) -> Iterator[tuple[str, Tensor, Logs]]:
        """Beside critics and actor, the state value learns the log's returns."""
        yield from super().warm_start_losses(batch)
        loss = (self.value(batch["observations"]) - batch["returns"]).square().mean()
        yield "value", loss, dict(warm_value_loss=loss)


def expectile_loss(difference: Tensor, expectile: float) -> Tensor:
    """`|tau - 1(u < 0)| u^2` of each difference u: its mean is least where u is measured from the expectile."""
    return torch.where(difference < 0, 1.0 - expectile, expectile) * difference.square()
