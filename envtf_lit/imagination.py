"""Branched rollouts: from real states, under a policy, through any world model, until the robot falls."""

import io
import json
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.loaders import Store, WeightedRows
from envtf_lit.errors import UserError
from envtf_lit.params import ImaginationOptions
from envtf_lit.policy import Policy, TanhGaussianActor
from envtf_lit.storage import replacing
from envtf_lit.world_models.interface import Mode, Prediction, WorldModel

Starts = tuple[
    Tensor, Tensor, Tensor, Tensor
]  # observations, actions, lengths, window, as `WorldModel.init` takes them


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


class BranchPoints:
    """Real states to branch from, with the real steps that led to them.

    Args:
        dataset: where they come from.
        device: where they go.
        weights: (N,) chances of each row, up to a factor; None draws uniformly.
    """

    def __init__(
        self, dataset: OfflineDataset, device: torch.device | str = "cpu", weights: Tensor | None = None
    ) -> None:
        self.rows = WeightedRows(torch.ones(len(dataset)) if weights is None else weights, device)
        self.observations = Store(dataset, ("observations",), device)
        self.actions = Store(dataset, ("actions",), device)
        self.starts = torch.as_tensor(dataset.episode_starts[dataset.episode_index], device=device)

    def draw(self, count: int, history: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Rows drawn at random, each with up to `history` steps before it: the arguments of `WorldModel.init`."""
        return self.at(self.rows.draw((count,), generator), history)

    def draw_shared(self, count: int, history: int, share: int, generator: torch.Generator) -> Starts:
        """`share` rows from each of some windows: the arguments of `WorldModel.init`, its windows too.

        Each row is drawn with the chance it has in `draw`; only, rows come from the same stretch of `share` steps, and
        nearly without repetition. The model then reads a window once, not once for each row.

        Args:
            count: rollouts; the last window may start fewer than `share`.
            history: steps before the stretch that a window begins with, at most.
            share: rows of a stretch.
            generator: of the rows.
        """
        device, windows = self.starts.device, -(-count // share)
        drawn = self.rows.draw((windows,), generator)  # by a row's chance the chance of its stretch
        offset = torch.randint(share, (windows,), generator=generator, device=device)
        into = drawn - self.starts[drawn]
        begin = drawn - (into + offset) % share  # the stretches of an episode, cut at a random offset
        stretch = begin[:, None] + torch.arange(share, device=device)  # (W, share)
        row = stretch.clamp(0, len(self.starts) - 1)
        inside = (stretch == row) & (self.starts[row] == self.starts[drawn][:, None])
        last = torch.where(inside, row, -1).amax(1)
        cumulative = (self.rows.chances(row) * inside).cumsum(1)
        shift = torch.rand(windows, 1, generator=generator, device=device, dtype=torch.float64)
        even = (torch.arange(share, device=device) + shift) / share * cumulative[:, -1:]
        picked = torch.searchsorted(cumulative, even, right=True)  # systematic: equal chances give every row once
        rows = torch.minimum(begin[:, None] + picked, last[:, None])  # (W, share)
        observations, actions, lengths = self.at(last, history + share - 1)
        first = last + 1 - lengths  # (W,) row that each window begins with
        window = torch.arange(windows, device=device).repeat_interleave(share)[:count]
        return observations, actions, (rows - first[:, None] + 1).flatten()[:count], window

    def at(self, row: Tensor, history: int) -> tuple[Tensor, Tensor, Tensor]:
        """These rows (B,), each with up to `history` steps before it: the arguments of `WorldModel.init`."""
        device = self.starts.device
        start = torch.maximum(row - history, self.starts[row])
        index = torch.minimum(
            start[:, None] + torch.arange(history + 1, device=device), row[:, None]
        )  # (B, history + 1)
        histories = self.observations[index]["observations"], self.actions[index[:, :-1]]["actions"]
        return *histories, row - start + 1


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


def _some(starts: tuple[Tensor, ...], branch: Tensor) -> tuple[Tensor, ...]:
    """The arguments of `init` for these rollouts (B,) alone."""
    observations, actions, lengths, *window = starts
    if not window:
        return observations[branch], actions[branch], lengths[branch]
    used, window = window[0][branch].unique(return_inverse=True)
    return observations[used], actions[used], lengths[branch], window


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


def save_rollouts(rollouts: Rollouts, path: str | Path, *, provenance: dict[str, Any]) -> None:
    """Writes all columns as HDF5, with `provenance` as a JSON attribute; equal rollouts give equal bytes."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name, column in vars(rollouts).items():
            file.create_dataset(name, data=column.cpu().numpy(), track_times=False)
        file.attrs["provenance"] = json.dumps(provenance, sort_keys=True)
    with replacing(path) as temporary:
        temporary.write_bytes(buffer.getvalue())


def load_rollouts(path: str | Path) -> Rollouts:
    """Reads what `save_rollouts` wrote.

    Raises:
        UserError: the file is missing, damaged, or lacks a column.
    """
    try:
        with h5py.File(path, "r") as file:
            return Rollouts(**{field.name: torch.as_tensor(file[field.name][()]) for field in fields(Rollouts)})  # pyright: ignore[reportIndexIssue]
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise UserError(f"{path} holds no imagined rollouts ({error}): run `envtf generate_rollouts`.") from None
