"""Imagined rollouts: from real states, under a policy, through any world model, until the robot falls."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from envtf_lit.actors import Actor
from envtf_lit.imagination.histories import Histories
from envtf_lit.policy import Policy
from envtf_lit.world_models.interface import Mode, WorldModel
from envtf_lit.world_models.unroll import Step, lost, unroll

Rule = Callable[[Tensor], Tensor]  # next observations (..., S) to bool (...): whether the robot has fallen


@dataclass(frozen=True)
class Rollouts:
    """B imagined rollouts of at most H steps; zeros stand where a rollout has ended before.

    Attributes:
        observations, next_observations: (H, B, S).
        actions: (H, B, A).
        rewards: (H, B), without any penalty.
        terminated: (H, B) bool, by the robot's rule.
        halted: (H, B) bool, where the rollout was given up because the model had left what it knows.
        aleatoric: (H, B, S + 1) predicted spread of (next observation, reward), as `Prediction.aleatoric`.
        uncertainty: (H, B) `Prediction.uncertainty` of each transition.
        valid: (H, B) bool, steps that were taken.
    """

    observations: Tensor
    actions: Tensor
    rewards: Tensor
    next_observations: Tensor
    terminated: Tensor
    halted: Tensor
    aleatoric: Tensor
    uncertainty: Tensor
    valid: Tensor

    def __len__(self) -> int:
        """Transitions."""
        return int(self.valid.sum())

    @classmethod
    def joined(cls, parts: "list[Rollouts]") -> "Rollouts":
        """Several batches side by side, as long as the longest."""
        longest = max(len(part.valid) for part in parts)
        padded = [[_padded(getattr(part, field.name), longest) for field in fields(cls)] for part in parts]
        return cls(*(torch.cat(columns, 1) for columns in zip(*padded, strict=True)))

    def returns(self, rewards: Tensor, discount: float) -> tuple[Tensor, Tensor, Tensor]:
        """Multi-step transitions that run from each step to the end of its rollout.

        Args:
            rewards: (H, B), `self.rewards` with whatever penalty.
            discount: per step.

        Returns:
            (H, B) discounted sum of rewards; (H, B, S) where the rollout ends; (H, B) what the value there counts for:
            `discount ** steps`, or zero if the robot fell.
        """
        total, weight = rewards.clone(), discount * (~self.terminated).float()
        end = self.next_observations.clone()
        for t in range(len(rewards) - 2, -1, -1):
            goes_on = self.valid[t + 1]
            total[t] = torch.where(goes_on, rewards[t] + discount * total[t + 1], total[t])
            weight[t] = torch.where(goes_on, discount * weight[t + 1], weight[t])
            end[t] = torch.where(goes_on[:, None], end[t + 1], end[t])
        return total, end, weight


def _padded(column: Tensor, length: int) -> Tensor:
    return torch.cat([column, column.new_zeros(length - len(column), *column.shape[1:])])


class NoisyPolicy:
    """A policy's sampled actions with Gaussian noise of a `scale` in units of half the action range, clipped to it."""

    def __init__(self, actor: Actor, scale: float) -> None:
        self.actor, self.scale = actor, scale

    def act(self, observation: Tensor, deterministic: bool = False, generator: torch.Generator | None = None) -> Tensor:
        """Observations (B, S) to actions (B, A)."""
        action = self.actor.act(observation, deterministic, generator)
        noise = torch.randn(action.shape, generator=generator, device=action.device)
        half_range = 0.5 * (self.actor.action_high - self.actor.action_low)
        return (action + self.scale * half_range * noise).clamp(self.actor.action_low, self.actor.action_high)


@torch.no_grad()
def imagine(
    model: WorldModel,
    policy: Policy,
    histories: Histories,
    *,
    horizon: int,
    terminated: Rule,
    expansion: int = 0,
    novelty_limit: float | None = None,
    mode: Mode = "sample",
    posterior: float = 0.0,
    generator: torch.Generator | None = None,
    batch_size: int = 4_096,
) -> Rollouts:
    """Rolls the policy's own (sampled) actions out through the model, at most `horizon` steps from each start.

    Rollouts that ended leave the batch, so that no work is spent on them.

    Args:
        model: any world model.
        policy: acts on (B, S).
        histories: where rollouts begin.
        horizon: steps of sampled actions.
        terminated: the robot's rule.
        expansion: further steps, with the policy's deterministic actions and mean predictions.
        novelty_limit: rollouts whose `Prediction.novelty` passes it end there, halted; None lets them go on.
        mode: of `WorldModel.step`, up to the horizon.
        posterior: of `WorldModel.init`.
        generator: of the actions and of sampled next states.
        batch_size: rollouts imagined at a time.

    Raises:
        UserError: a novelty limit is given and the model has no epistemic variance.
    """
    rows = torch.arange(len(histories), device=histories.lengths.device)
    parts = []
    for some in rows.split(batch_size):
        state = histories[some].begin(model, posterior=posterior, generator=generator)
        ended = torch.zeros(len(some), dtype=torch.bool, device=some.device)

        def act(t: int, rows: Tensor, observation: Tensor) -> Tensor:
            return policy.act(observation, deterministic=t >= horizon, generator=generator)

        def select(t: int, rows: Tensor, ended: Tensor = ended) -> Tensor | None:
            over = ended[rows]
            return (~over).nonzero()[:, 0] if t > 0 and bool(over.any()) else None

        def how(t: int) -> Mode:
            return mode if t < horizon else "mean"

        steps = unroll(model, state, act, horizon + expansion, mode=how, select=select, generator=generator)
        columns = []
        for step in steps:
            fell = terminated(step.prediction.observation)
            halted = ~fell & lost(step.prediction, novelty_limit)
            ended[step.rows] = fell | halted
            columns.append((step, fell, halted))
        parts.append(gather_steps(columns, len(some)))
    return Rollouts.joined(parts)


def gather_steps(steps: Iterable[tuple[Step, Tensor, Tensor]], count: int) -> Rollouts:
    """Steps of rollouts, of which some may have ended, as whole columns.

    Args:
        steps: each with (R,) bool terminated and halted.
        count: B, rollouts at the start.
    """
    table = []
    for step, terminated, halted in steps:
        p = step.prediction
        taken = torch.ones_like(terminated)
        row = (step.observation, step.action, p.reward, p.observation, terminated, halted)
        row = (*row, p.aleatoric, p.uncertainty, taken)
        whole = len(step.rows) == count
        table.append(row if whole else tuple(_spread(column, step.rows, count) for column in row))
    return Rollouts(*(torch.stack(columns) for columns in zip(*table, strict=True)))


def _spread(column: Tensor, rows: Tensor, count: int) -> Tensor:
    """Values (R, …) of some rows as (B, …), zeros elsewhere."""
    return column.new_zeros(count, *column.shape[1:]).index_copy(0, rows, column)
