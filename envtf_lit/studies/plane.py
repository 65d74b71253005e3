"""A point on a plane: a problem in which all that a critic believes can be drawn, and a lie be told from the truth."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from envtf_lit.agents.actor_critic import ActorCritic
from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.data.dataset import OfflineDataset, starts_from_ends
from envtf_lit.divergence import Diverged
from envtf_lit.options.schema import build
from envtf_lit.pipeline.train_policy import transition_data
from envtf_lit.policy import Policy
from envtf_lit.training import Curves, run_folder, trained

STEP = 0.15  # of the plane, of one action
GOAL, START, CORNER = (0.8, 0.8), (-0.8, -0.8), (-0.8, 0.8)
BLOCK = 0.45  # half the side of the block
STEPS = 40  # of an episode
WANDER = 0.25  # standard deviation of the recorded actions


def move(states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rule: `s' = s + 0.15 a`, kept in [-1, 1], and s' = s where that leads into the block in the middle.

    The reward is minus the distance of s' to the goal, never above 0.

    Args:
        states: (N, 2).
        actions: (N, 2) in [-1, 1].

    Returns:
        Next states (N, 2) and rewards (N,).
    """
    following = np.clip(states + STEP * actions, -1.0, 1.0)
    following = np.where((np.abs(following) < BLOCK).all(1, keepdims=True), states, following)
    return following, -np.linalg.norm(following - np.array(GOAL), axis=1)


def plane_log(episodes: int, *, seed: int, noise: float = WANDER) -> OfflineDataset:
    """A log of somebody who takes the detour: up along the left edge, then right along the upper one, with noise.

    Args:
        episodes: of 40 steps each, none of which terminates.
        seed: of starts and noise.
        noise: standard deviation of the recorded actions.
    """
    rng, columns = np.random.default_rng(seed), []
    states = np.array(START) + 0.08 * rng.normal(size=(episodes, 2))
    for step in range(STEPS):
        turned = states[:, 1] > CORNER[1] - 0.15
        towards = np.where(turned[:, None], np.array(GOAL), np.array(CORNER)) - states
        intended = np.clip(towards / STEP, -0.6, 0.6)
        actions = np.clip(intended + noise * rng.normal(size=states.shape), -1.0, 1.0)
        following, rewards = move(states, actions)
        columns.append((states, actions, rewards, following, np.full(episodes, step == STEPS - 1)))
        states = following
    rows = [
        np.stack(column, 1).reshape(episodes * STEPS, *column[0].shape[1:]) for column in zip(*columns, strict=True)
    ]
    observations, actions, rewards, following = (column.astype(np.float32) for column in rows[:4])
    ends = rows[4].astype(bool)
    return OfflineDataset(
        observations=observations,
        actions=actions,
        rewards=rewards,
        next_observations=following,
        terminated=np.zeros(len(ends), bool),
        truncated=ends,
        episode_starts=starts_from_ends(ends),
        action_low=-np.ones(2, np.float32),
        action_high=np.ones(2, np.float32),
    )


def walk(policy: Policy, episodes: int, *, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """What a policy does on the plane: paths (E, 41, 2) of its deterministic actions, and returns (E,)."""
    rng = np.random.default_rng(seed)
    states = np.array(START) + 0.08 * rng.normal(size=(episodes, 2))
    paths, returns = [states], np.zeros(episodes)
    for _ in range(STEPS):
        actions = policy.act(torch.from_numpy(states.astype(np.float32))).numpy()
        states, rewards = move(states, actions)
        paths.append(states)
        returns += rewards
    return np.stack(paths, 1), returns


@dataclass(frozen=True, eq=False)
class Learned:
    """An agent with critics after its training.

    Attributes:
        agent: with its critics, which no published folder has.
        curves: a row per epoch.
        stopped: the sentence of the guard, where it stopped a training that diverged; None where it ran to its end.
    """

    agent: ActorCritic
    curves: pd.DataFrame
    stopped: str | None

    @torch.no_grad()
    def q(self, state: np.ndarray, bins: int) -> np.ndarray:
        """(bins, bins) the smaller critic's Q in a state (2,) of all actions, the first dimension first; in rewards."""
        line = torch.linspace(-1.0, 1.0, bins)
        actions = torch.cartesian_prod(line, line)
        states = torch.from_numpy(state.astype(np.float32)).expand(len(actions), -1)
        found = self.agent.critics(states, actions).min(0).values * self.agent.return_scale
        return found.view(bins, bins).numpy()


class _Diary(Curves):
    """Curves that outlive a training that is stopped; a type of its own, by which Lightning tells callbacks apart."""


def learn(algorithm: str, dataset: Path, *, seed: int, **options: Any) -> Learned:
    """Trains an algorithm that has critics on a log, and keeps it whole.

    Args:
        algorithm: that learns from data alone, such as `sac` or `cql`.
        dataset: HDF5 or NPZ.
        seed: of everything random; global seeds are the caller's.
        options: of the algorithm.
    """
    cls = ALGORITHMS[algorithm]
    chosen = build(cls.Options, options, "")
    data, diary, stopped = transition_data(dataset, chosen, seed=seed), _Diary(), None
    limits = data.dataset.action_low.tolist(), data.dataset.action_high.tolist()
    agent = cls(data.observation_dim, data.action_dim, chosen, *limits, seed=seed)
    assert isinstance(agent, ActorCritic)
    run = run_folder(Path("."), algorithm, options | {"seed": seed}, [dataset])
    try:
        with trained(
            agent,
            data,
            run=run,
            target=None,
            epochs=chosen.updates // chosen.updates_per_epoch,
            precision="fp32",
            progress=False,
            validate=False,
            callbacks=[diary],
        ):
            pass
    except Diverged as found:
        stopped = str(found)
        shutil.rmtree(run, ignore_errors=True)  # or the next call would go on from there
    return Learned(agent, pd.DataFrame(diary.rows), stopped)
