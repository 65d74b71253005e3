"""Branched rollouts: from real states, under a policy, through any world model, until the robot falls."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.errors import UserError
from envtf_lit.imagination.histories import BranchPoints, Starts, _some
from envtf_lit.imagination.options import ImaginationOptions
from envtf_lit.policy import Policy, TanhGaussianActor
from envtf_lit.world_models.interface import Mode, Prediction, WorldModel


@dataclass(frozen=True)
class Rollouts:
    """M imagined transitions, ordered by step and then by branch.

    Attributes:
        observations, next_observations: (M, S).
        actions: (M, A).
        rewards: (M,), without any penalty.
        terminated: (M,) bool, by the robot's rule.
        halted: (M,) bool, where the rollout was given up because the model had left what it knows.
        aleatoric: (M, S + 1) predicted spread of (next observation, reward), as `Prediction.aleatoric`.
        uncertainty: (M,) `Prediction.uncertainty` of each transition.
        branch: (M,) which rollout; step: (M,) how many imagined steps came before.
    """

    observations: Tensor
    actions: Tensor
    rewards: Tensor
    next_observations: Tensor
    terminated: Tensor
    halted: Tensor
    aleatoric: Tensor
    uncertainty: Tensor
    branch: Tensor
    step: Tensor

    def __len__(self) -> int:
        return len(self.rewards)

    def returns(self, rewards: Tensor, discount: float) -> tuple[Tensor, Tensor, Tensor]:
        """Multi-step transitions that run from each imagined step to the end of its rollout.

        Args:
            rewards: (M,), `self.rewards` with whatever penalty.
            discount: per step.

        Returns:
            (M,) discounted sum of rewards; (M, S) where the rollout ends; (M,) what the value there counts for:
            `discount ** steps`, or zero if the robot fell.
        """
        total, weight, end = rewards.clone(), discount * (~self.terminated).float(), self.next_observations.clone()
        latest = torch.full((int(self.branch.max()) + 1,), -1, device=self.branch.device)
        for step in range(int(self.step.max()), -1, -1):
            rows = (self.step == step).nonzero()[:, 0]
            following = latest[self.branch[rows]]  # the same rollout's next step
            rows, following = rows[following >= 0], following[following >= 0]
            total[rows] += discount * total[following]
            weight[rows] = discount * weight[following]
            end[rows] = end[following]
            rows = (self.step == step).nonzero()[:, 0]
            latest[self.branch[rows]] = rows
        return total, end, weight


class NoisyPolicy:
    """A policy's sampled actions with Gaussian noise of a `scale` in units of half the action range, clipped to it."""

    def __init__(self, actor: TanhGaussianActor, scale: float) -> None:
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
    starts: tuple[Tensor, Tensor, Tensor] | Starts,
    *,
    horizon: int,
    terminated: Callable[[Tensor], Tensor],
    tail: int = 0,
    novelty_limit: float | None = None,
    mode: Mode = "sample",
    posterior: float = 0.0,
    generator: torch.Generator | None = None,
    batch_size: int = 4_096,
) -> Rollouts:
    """Rolls the policy's own (sampled) actions out through the model, at most `horizon` steps from each start.

    Rollouts that ended leave the batch, so that no work is spent on them.

    Args:
        model: any world model; `starts` are the arguments of its `init`.
        policy: acts on (B, S).
        terminated: the robot's rule, next observations (B, S) to bool (B,).
        novelty_limit: rollouts whose `Prediction.novelty` passes it end there, halted; None lets them go on.
        tail: further steps, with the policy's deterministic actions and mean predictions.
        mode: of `WorldModel.step`.
        posterior: of `WorldModel.init`.
        generator: of the actions and of sampled next states.
        batch_size: rollouts imagined at a time.
    """
    parts: list[Rollouts] = []
    count = len(starts[2])
    for begin in range(0, count, batch_size):
        branch = torch.arange(begin, min(begin + batch_size, count), device=starts[2].device)
        state = model.init(*_some(starts, branch), posterior=posterior, generator=generator)
        for step in range(horizon + tail):
            actor, how = (policy, mode) if step < horizon else (_Deterministic(policy), "mean")
            part, state = _advance(model, actor, state, branch, step, terminated, novelty_limit, how, generator)
            parts.append(part)
            alive = (~(part.terminated | part.halted)).nonzero()[:, 0]
            if len(alive) == 0:
                break
            if len(alive) < len(branch):
                state, branch = model.gather(state, alive), branch[alive]
    return Rollouts(**{field.name: torch.cat([getattr(p, field.name) for p in parts]) for field in fields(Rollouts)})


class Imagination:
    """A world model at an agent's service: branched rollouts to learn from, whole episodes to be judged by.

    Args:
        model: any world model, on `device`.
        dataset: gives the states to branch from and the first states of episodes.
        terminated: the robot's rule.
        options: of the rollouts and of the judgement.
        weights: (N,) chances of each row to be branched from; None draws uniformly.
    """

    def __init__(
        self,
        model: WorldModel,
        dataset: OfflineDataset,
        terminated: Callable[[Tensor], Tensor],
        options: ImaginationOptions,
        device: torch.device | str = "cpu",
        weights: Tensor | None = None,
    ) -> None:
        self.model, self.terminated, self.options = model, terminated, options
        self.starts = BranchPoints(dataset, device, weights)
        chosen = np.linspace(0, len(dataset.episode_starts) - 1, max(1, options.selection_episodes)).astype(int)
        self.first = torch.as_tensor(dataset.observations[dataset.episode_starts[chosen]], device=device)

    def rollouts(self, policy: Policy, generator: torch.Generator) -> Rollouts:
        """New branched rollouts under the policy's sampled actions."""
        o = self.options
        starts = self.starts.draw_shared(o.branches, o.history, o.share, generator)
        return imagine(
            self.model,
            policy,
            starts,
            horizon=o.horizon,
            tail=o.tail,
            terminated=self.terminated,
            novelty_limit=o.novelty_limit,
            mode=o.mode,
            posterior=o.posterior,
            generator=generator,
        )

    def imagined_return(self, policy: Policy) -> float:
        """Mean undiscounted return of imagined episodes, from recorded first states, deterministic actions, mean model.

        Episodes last `selection_steps`, unless the robot falls first.
        """
        B = len(self.first)
        no_actions = self.first.new_zeros(B, 0, self.model.action_dim)
        starts = self.first[:, None], no_actions, torch.ones(B, dtype=torch.long, device=self.first.device)
        episodes = imagine(
            self.model,
            policy,
            starts,
            horizon=0,
            tail=self.options.selection_steps,
            terminated=self.terminated,
            novelty_limit=self.options.novelty_limit,
        )
        return float(episodes.rewards.double().sum() / B)


class _Deterministic:
    """The same policy without its noise."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy

    def act(self, observation: Tensor, deterministic: bool = True, generator: torch.Generator | None = None) -> Tensor:
        return self.policy.act(observation, True, generator)


def _advance(
    model: WorldModel,
    policy: Policy,
    state: Any,
    branch: Tensor,
    step: int,
    terminated: Callable[[Tensor], Tensor],
    novelty_limit: float | None,
    mode: Mode,
    generator: torch.Generator | None,
) -> tuple[Rollouts, Any]:
    """One step of all rollouts that are still alive."""
    observation = model.current(state)
    action = policy.act(observation, deterministic=False, generator=generator)
    state, prediction = model.step(state, action, mode=mode, generator=generator)
    fell = terminated(prediction.observation)
    part = Rollouts(
        observations=observation,
        actions=action,
        rewards=prediction.reward,
        next_observations=prediction.observation,
        terminated=fell,
        halted=torch.zeros_like(fell) if novelty_limit is None else ~fell & (_novelty(prediction) > novelty_limit),
        aleatoric=prediction.aleatoric,
        uncertainty=prediction.uncertainty,
        branch=branch,
        step=torch.full_like(branch, step),
    )
    return part, state


def _novelty(prediction: Prediction) -> Tensor:
    if prediction.novelty is None:
        raise UserError(
            "novelty_limit is set and the world model has no epistemic variance to hold against it: train a "
            "transformer with epistemic: laplace or an ensemble of several members, or set novelty_limit to null."
        )
    return prediction.novelty
