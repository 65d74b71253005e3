"""Soft Actor-Critic (Haarnoja et al. 2018): critics and their targets, a Gaussian actor, a learned temperature."""

import contextlib
import copy
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from envtf_lit.agents.agent import Agent, Batch, Logs, Losses, Part, Phase, follow
from envtf_lit.agents.networks import StackedCritics
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.warm_start import WarmStart
from envtf_lit.options.numbers import NonNegative

INITIAL_ALPHA = 0.01  # weight of the entropy in the actor's objective at the start; learned from there on
WARM_TARGET_RATE = 0.05  # share of the critics that enters the target networks at each update of the warm start
CRITICS = 2  # of which targets and actor take the smallest


@dataclass(frozen=True)
class SACOptions(PolicyOptions):
    """Soft Actor-Critic's own options.

    Attributes:
        clone_weight: weight in the actor's objective of cloning the real rows' actions, which keeps it near the log; of
            the mean over action dimensions.
    """

    clone_weight: NonNegative = 0.75


class Temperature(nn.Module):
    """`alpha`, the weight of the entropy, as its logarithm."""

    def __init__(self) -> None:
        super().__init__()
        self.log_alpha = nn.Parameter(torch.tensor(INITIAL_ALPHA).log())


class SAC(Agent):
    """Soft Actor-Critic on a log."""

    Options: ClassVar[type[PolicyOptions]] = SACOptions
    label = "SAC"
    cures: ClassVar[Mapping[str, str]] = {
        "": "lower critic_learning_rate, or warm up for longer with a larger warm_start"
    }
    options: SACOptions

    def build_networks(self) -> None:
        o = self.options
        self.critics = StackedCritics(
            self.observation_dim, self.action_dim, n=CRITICS, hidden=o.hidden, layer_norm=o.layer_norm
        )
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.temperature = Temperature()

    def build_phases(self) -> list[Phase]:
        warm = self.options.warm_updates
        return [WarmStart(warm), Losses(self.options.updates - warm)]

    def parts(self) -> dict[str, Part]:
        o = self.options
        return dict(
            actor=Part(self.actor, o.actor_learning_rate),
            critics=Part(self.critics, o.critic_learning_rate),
            temperature=Part(self.temperature, o.actor_learning_rate),
        )

    def rate(self, part: str, progress: float) -> float:
        rate = super().rate(part, progress)
        if part == "actor" and self.options.actor_schedule == "cosine":
            rate *= 0.5 * (1.0 + math.cos(math.pi * progress))
        return rate

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

    def update_targets(self) -> None:
        """Target critics follow the critics, the averaged actor the actor."""
        follow(self.target_critics, self.critics, self.options.target_rate)
        super().update_targets()

    @torch.no_grad()
    def complete_returns(self, batch: Batch) -> Batch:
        """`G + gamma^n min_i Q_i'(s_T, a'), a' ~ pi(s_T)` for episodes that were cut after n steps, in s_T.

        What terminated keeps its return. The targets Q' follow the critics faster than later on: every other row holds
        them to what was earned, so that nothing can run away.
        """
        follow(self.target_critics, self.critics, WARM_TARGET_RATE)
        action, _ = self.actor.sample(batch["last_observations"], generator=self.generator)
        beyond = self.target_critics(batch["last_observations"], action).min(0).values
        return batch | {"returns": batch["returns"] + batch["tails"] * beyond}

    def warm_start_losses(self, batch: Batch) -> Iterator[tuple[str, Tensor, Logs]]:
        """Critics regress on Monte-Carlo returns of the log, as `complete_returns` makes them; the actor clones it."""
        q = self.critics(batch["observations"], batch["actions"])
        loss = 0.5 * (q - batch["returns"]).square().mean(1).sum()
        yield "critics", loss, dict(warm_critic_loss=loss, q_data=q.mean())
        yield from super().warm_start_losses(batch)

    def end_warm_start(self) -> None:
        self.target_critics.load_state_dict(self.critics.state_dict())
        super().end_warm_start()

    def validation_logs(self, batch: Batch) -> Logs:
        q = self.return_scale * self.critics(batch["observations"], batch["actions"]).min(0).values
        returns = batch["returns"] + batch["tails"] * self.typical_return
        return dict(q_data=q.mean(), return_error=((q - returns) / self.return_spread).square().mean())


@contextlib.contextmanager
def held_fixed(module: nn.Module) -> Iterator[None]:
    """Gradients pass through a module's parameters, but do not reach them."""
    module.requires_grad_(False)
    try:
        yield
    finally:
        module.requires_grad_(True)
