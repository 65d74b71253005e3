"""TD3+BC (Fujimoto & Gu 2021): a deterministic actor that climbs Q, tied to the recorded actions by their distance."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from envtf_lit.actors import Actor, DeterministicActor
from envtf_lit.agents.actor_critic import ActorCritic, held_fixed
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.phases import Batch, Logs, Part, follow
from envtf_lit.options.numbers import Count, NonNegative


@dataclass(frozen=True)
class TD3Options(PolicyOptions):
    """What TD3+BC and ReBRAC have in common.

    Attributes:
        policy_delay: updates of the critics for each one of the actor and of all targets.
        target_noise: standard deviation of the noise on the target actor's actions, in units of half the action range.
        noise_clip: largest noise, in the same units.
    """

    policy_delay: Count = 2
    target_noise: NonNegative = 0.2
    noise_clip: NonNegative = 0.5


class TD3(ActorCritic):
    """Twin delayed deterministic policy gradient (Fujimoto et al. 2018): what both actors' losses are put upon."""

    actor_kind: ClassVar[type[Actor]] = DeterministicActor
    actor: DeterministicActor
    options: TD3Options

    def build_networks(self) -> None:
        super().build_networks()
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)

    def setup(self, stage: str) -> None:
        super().setup(stage)
        self.target_actor.load_state_dict(self.actor.state_dict())  # which may have begun from another

    def parts(self) -> dict[str, Part]:
        o = self.options
        return dict(actor=Part(self.actor, o.actor_learning_rate), critics=Part(self.critics, o.critic_learning_rate))

    def losses(self, batch: Batch) -> Iterator[tuple[str, Tensor, Logs]]:
        critic_loss, logs = self.critic_loss(batch)
        yield "critics", critic_loss, logs
        if self.due:
            with held_fixed(self.critics):
                actor_loss, logs = self.actor_loss(batch)
                yield "actor", actor_loss, logs

    @property
    def due(self) -> bool:
        """Whether the actor and all targets learn in this update, too."""
        return (self.update_index + 1) % self.options.policy_delay == 0

    def critic_loss(self, batch: Batch) -> tuple[Tensor, Logs]:
        """`(Q_i(s, a) - y)^2`, summed over critics."""
        with torch.no_grad():
            target = self.td_target(batch)
        q = self.critics(batch["observations"], batch["actions"])
        loss = (q - target).square().mean(1).sum()
        return loss, dict(bellman_loss=loss, q_data=q.mean(), q_target=target.mean())

    def td_target(self, batch: Batch) -> Tensor:
        """`y = r + gamma min_i Q_i'(s', a')`, a' of the noisy target actor (Fujimoto et al. 2018, equation 14)."""
        action = self.noisy_target(batch["next_observations"])
        following = self.target_critics(batch["next_observations"], action).min(0).values
        return batch["rewards"] + batch["discounts"] * following

    def noisy_target(self, observation: Tensor) -> Tensor:
        """`clip(pi'(s) + clip(noise))`: observations (B, S) to actions (B, A)."""
        o, low, high = self.options, self.actor.action_low, self.actor.action_high
        action = self.target_actor(observation)
        noise = o.target_noise * torch.randn(action.shape, generator=self.generator, device=action.device)
        noise = noise.clamp(-o.noise_clip, o.noise_clip) * 0.5 * (high - low)
        return torch.minimum(torch.maximum(action + noise, low), high)

    def actor_loss(self, batch: Batch) -> tuple[Tensor, Logs]:
        """What the actor makes small, and what to log."""
        raise NotImplementedError

    def update_targets(self) -> None:
        if self.due:
            follow(self.target_actor, self.actor, self.options.target_rate)
            super().update_targets()

    def end_warm_start(self) -> None:
        self.target_actor.load_state_dict(self.actor.state_dict())
        super().end_warm_start()


@dataclass(frozen=True)
class TD3BCOptions(TD3Options):
    """TD3+BC's own option.

    Attributes:
        alpha: weight of Q against the distance to the recorded actions; 0 clones them.
    """

    alpha: NonNegative = 2.5


class TD3BC(TD3):
    """TD3 with a term of behaviour cloning."""

    Options: ClassVar[type[PolicyOptions]] = TD3BCOptions
    label = "TD3+BC"
    options: TD3BCOptions

    def actor_loss(self, batch: Batch) -> tuple[Tensor, Logs]:
        """`-lambda Q_1(s, pi(s)) + (pi(s) - a)^2`, `lambda = alpha / mean |Q_1|` held fixed (equations 3 and 5).

        The square is the mean over action dimensions, in shares of the range from -1 to 1.
        """
        q = self.critics(batch["observations"], self.actor(batch["observations"]))[0]
        weight = self.options.alpha / q.abs().mean().clamp(min=1e-6).detach()
        clone_loss = self.clone_loss(batch)
        return clone_loss - weight * q.mean(), dict(q_policy=q.mean(), clone_loss=clone_loss)
