"""The offline dataset: aligned columns of transitions, grouped into episodes, validated once and immutable after."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from torch import Tensor

from envtf_lit.data.columns import Column, take
from envtf_lit.data.statistics import DatasetStatistics
from envtf_lit.errors import UserError

COLUMNS = ("observations", "actions", "rewards", "next_observations", "terminated", "truncated")


@dataclass(frozen=True, eq=False, repr=False)
class OfflineDataset:
    """N transitions `(s, a, r, s')` with S observation and A action dimensions, stored episode after episode.

    `next_observations` is stored, never guessed from the following row. `terminated` says that the task ended in s'
    (no future reward), `truncated` that the log stopped there (the future is unknown, so bootstrap through it). Every
    episode ends at a row where either is set, or at the last row.

    Attributes:
        observations: (N, S) float32; of a large file, like the other wide columns, a `FileRows` that is read by rows.
        actions: (N, A) float32.
        rewards: (N,) float32.
        next_observations: (N, S) float32.
        terminated, truncated: (N,) bool.
        episode_starts: (E,) int64, ascending, the first is 0.
        task: the task's name, such as `hopper-medium-replay`, or None where no environment is known.
        action_low, action_high: (A,) float32, the action space.
        held_out: (E,) bool, the episodes that nothing learns from, some but not all; None where nobody chose them yet.
    """

    observations: Column
    actions: Column
    rewards: np.ndarray
    next_observations: Column
    terminated: np.ndarray
    truncated: np.ndarray
    episode_starts: np.ndarray
    action_low: np.ndarray
    action_high: np.ndarray
    task: str | None = field(default=None)
    held_out: np.ndarray | None = field(default=None)

    def __repr__(self) -> str:
        task = "" if self.task is None else f"{self.task}: "
        sizes = f"observations of {self.observation_dim}, actions of {self.action_dim}"
        return f"<OfflineDataset {task}{len(self):,} steps in {len(self.episode_starts):,} episodes, {sizes}>"

    def __len__(self) -> int:
        return len(self.rewards)

    @property
    def observation_dim(self) -> int:
        return self.observations.shape[1]

    @property
    def action_dim(self) -> int:
        return self.actions.shape[1]

    @cached_property
    def episode_ends(self) -> np.ndarray:
        """(E,) one past the last row of each episode."""
        return np.append(self.episode_starts[1:], len(self))

    @cached_property
    def episode_lengths(self) -> np.ndarray:
        """(E,) rows of each episode."""
        return self.episode_ends - self.episode_starts

    @cached_property
    def episode_returns(self) -> np.ndarray:
        """(E,) undiscounted sum of rewards of each episode, summed in float64."""
        return np.add.reduceat(self.rewards.astype(np.float64), self.episode_starts)

    @cached_property
    def episode_index(self) -> np.ndarray:
        """(N,) the episode each row belongs to."""
        return np.repeat(np.arange(len(self.episode_starts)), self.episode_lengths)

    def finished(self, limit: int) -> np.ndarray:
        """(E,) bool, the episodes that terminated or came to a limit of so many steps: others are cut short."""
        return self.terminated[self.episode_ends - 1] | (self.episode_lengths >= limit)

    @cached_property
    def statistics(self) -> DatasetStatistics:
        """Means, standard deviations and ranges of the columns."""
        return DatasetStatistics(self)

    def observation_scale(self) -> tuple[Tensor, Tensor]:
        """Mean and `Moments.scale` (S,) float32, with which policies z-score their inputs."""
        observations = self.statistics.observations
        return observations.mean.float(), observations.scale.float()

    def select(self, episodes: Sequence[int] | np.ndarray) -> "OfflineDataset":
        """The dataset of these episodes, in the order given; none of them is marked as held out."""
        episodes = np.asarray(episodes, dtype=np.int64)
        if len(episodes) == 0:
            raise UserError("A dataset needs at least one episode: none was selected.")
        lengths = self.episode_lengths[episodes]
        starts = np.concatenate([[0], np.cumsum(lengths)[:-1]])
        rows = np.arange(lengths.sum()) + np.repeat(self.episode_starts[episodes] - starts, lengths)
        columns: dict[str, Any] = {name: take(getattr(self, name), rows) for name in COLUMNS}
        return OfflineDataset(
            **columns,
            episode_starts=starts,
            action_low=self.action_low,
            action_high=self.action_high,
            task=self.task,
        )

    def with_split(self, share: float, seed: int) -> "OfflineDataset":
        """The same, with a share of the episodes drawn to be held out; at least one episode lands on each side.

        Args:
            share: of the episodes, in (0, 1).
            seed: of the random permutation of the episodes.
        """
        count = len(self.episode_starts)
        if count < 2:
            raise UserError("The dataset has one episode and two are needed, to hold one out: collect more episodes.")
        number = min(max(1, round(share * count)), count - 1)
        held_out = np.zeros(count, bool)
        held_out[np.random.default_rng(seed).permutation(count)[:number]] = True
        return replace(self, held_out=held_out)

    def validation_and_test(self) -> tuple["OfflineDataset", "OfflineDataset"]:
        """Held-out episodes in two: what chooses a model and fits its intervals, and what nothing is chosen by.

        Every other episode goes to either; a lone one is both.
        """
        count = len(self.episode_starts)
        return self.select(range(1 % count, count, 2)), self.select(range(0, count, 2))

    def split(self, share: float | None = None, *, seed: int = 0) -> tuple["OfflineDataset", "OfflineDataset"]:
        """By whole episodes into (training, held-out), each without a split of its own.

        Args:
            share: as of `with_split`, where the dataset does not say itself which episodes are held out.
            seed: likewise.
        """
        if self.held_out is None:
            if share is None:
                raise UserError("The dataset does not say which episodes are held out: give it a split (with_split).")
            return self.with_split(share, seed).split()
        return self.select(np.flatnonzero(~self.held_out)), self.select(np.flatnonzero(self.held_out))

    def returns_to_go(self, discount: float) -> np.ndarray:
        """(N,) float32, `G_t = r_t + discount * G_{t+1}` to the end of the episode, where G is zero beyond the log.

        A truncated episode's lack what would have followed: see `loaders.Transitions`.
        """
        returns = np.zeros(len(self), dtype=np.float64)
        longest = int(self.episode_lengths.max())
        following = np.zeros(len(self.episode_starts))
        for offset in range(longest):  # from each episode's last row backwards, all episodes at once
            alive = np.flatnonzero(self.episode_lengths > offset)
            rows = self.episode_ends[alive] - 1 - offset
            following[alive] = self.rewards[rows] + discount * following[alive]
            returns[rows] = following[alive]
        return returns.astype(np.float32)


def starts_from_ends(ends: np.ndarray) -> np.ndarray:
    """(E,) episode starts from an (N,) boolean column that marks each episode's last row; the last row always ends."""
    return np.concatenate([[0], np.flatnonzero(ends[:-1]) + 1]).astype(np.int64)
