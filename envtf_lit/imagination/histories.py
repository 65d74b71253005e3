"""Real states to begin imagined rollouts at, with the steps that led to them."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.loaders import Store, WeightedRows
from envtf_lit.world_models.interface import WorldModel


@dataclass(frozen=True)
class Histories:
    """What B rollouts have seen when they begin; their last observation has no action yet.

    Attributes:
        observations: (W, T, S) windows of a log, right-padded.
        actions: (W, T - 1, A), right-padded.
        lengths: (B,) observations of its window that each rollout has seen, 1 to T.
        window: (B,) the window of each rollout; None where each has one of its own, W = B.
    """

    observations: Tensor
    actions: Tensor
    lengths: Tensor
    window: Tensor | None = None

    def __len__(self) -> int:
        return len(self.lengths)

    def __getitem__(self, rollouts: Tensor) -> "Histories":
        """Those of these rollouts (R,) alone."""
        if self.window is None:
            return Histories(self.observations[rollouts], self.actions[rollouts], self.lengths[rollouts])
        used, window = self.window[rollouts].unique(return_inverse=True)
        return Histories(self.observations[used], self.actions[used], self.lengths[rollouts], window)

    @property
    def present(self) -> Tensor:
        """(B, S) the last observation of each."""
        window = torch.arange(len(self), device=self.lengths.device) if self.window is None else self.window
        return self.observations[window, self.lengths - 1]

    def to(self, device: torch.device | str) -> "Histories":
        """The same on another device."""
        columns = self.observations, self.actions, self.lengths, self.window
        return Histories(*(column if column is None else column.to(device) for column in columns))  # pyright: ignore[reportArgumentType]

    def begin(self, model: WorldModel, *, posterior: float = 0.0, generator: torch.Generator | None = None) -> Any:
        """The model's state after these histories; arguments as of `WorldModel.init`."""
        columns = self.observations, self.actions, self.lengths, self.window
        return model.init(*columns, posterior=posterior, generator=generator)


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
        self.firsts = torch.as_tensor(dataset.episode_starts, device=device)  # (E,)

    def draw(self, count: int, history: int, generator: torch.Generator) -> Histories:
        """Rows drawn at random, each with up to `history` steps before it."""
        return self.at(self.rows.draw((count,), generator), history)

    def draw_firsts(self, count: int, generator: torch.Generator) -> Tensor:
        """(count,) rows that episodes begin with, all episodes alike."""
        drawn = torch.randint(len(self.firsts), (count,), generator=generator, device=self.firsts.device)
        return self.firsts[drawn]

    def draw_with_firsts(self, count: int, history: int, share: float, generator: torch.Generator) -> Histories:
        """As `draw`, but this share of the rows, in expectation, as `draw_firsts`."""
        rows, firsts = self.rows.draw((count,), generator), self.draw_firsts(count, generator)
        chosen = torch.rand(count, generator=generator, device=rows.device) < share
        return self.at(torch.where(chosen, firsts, rows), history)

    def draw_stretches(self, count: int, history: int, length: int, generator: torch.Generator) -> Histories:
        """`length` rows from each of some stretches of as many consecutive steps.

        Each row is drawn with the chance it has in `draw`; only, rows come from the same stretch, and nearly without
        repetition. The model then reads a window once, not once for each row.

        Args:
            count: rollouts; the last window may begin fewer than `length`.
            history: steps before the stretch that a window begins with, at most.
            length: of a stretch, and rows drawn from it.
            generator: of the rows.
        """
        device, windows = self.starts.device, -(-count // length)
        drawn = self.rows.draw((windows,), generator)  # by a row's chance the chance of its stretch
        offset = torch.randint(length, (windows,), generator=generator, device=device)
        into = drawn - self.starts[drawn]
        begin = drawn - (into + offset) % length  # the stretches of an episode, cut at a random offset
        stretch = begin[:, None] + torch.arange(length, device=device)  # (W, length)
        row = stretch.clamp(0, len(self.starts) - 1)
        inside = (stretch == row) & (self.starts[row] == self.starts[drawn][:, None])
        last = torch.where(inside, row, -1).amax(1)
        cumulative = (self.rows.chances(row) * inside).cumsum(1)
        shift = torch.rand(windows, 1, generator=generator, device=device, dtype=torch.float64)
        even = (torch.arange(length, device=device) + shift) / length * cumulative[:, -1:]
        picked = torch.searchsorted(cumulative, even, right=True)  # systematic: equal chances give every row once
        rows = torch.minimum(begin[:, None] + picked, last[:, None])  # (W, length)
        seen = self.at(last, history + length - 1)
        first = last + 1 - seen.lengths  # (W,) row that each window begins with
        window = torch.arange(windows, device=device).repeat_interleave(length)[:count]
        lengths = (rows - first[:, None] + 1).flatten()[:count]
        return Histories(seen.observations, seen.actions, lengths, window)

    def at(self, row: Tensor, history: int) -> Histories:
        """These rows (B,), each with up to `history` steps before it."""
        device = self.starts.device
        start = torch.maximum(row - history, self.starts[row])
        index = torch.minimum(
            start[:, None] + torch.arange(history + 1, device=device), row[:, None]
        )  # (B, history + 1)
        observations, actions = self.observations[index]["observations"], self.actions[index[:, :-1]]["actions"]
        return Histories(observations, actions, row - start + 1)
