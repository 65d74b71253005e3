"""Real states to branch imagined rollouts from, with the steps that led to them."""

import torch
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.loaders import Store, WeightedRows

Starts = tuple[
    Tensor, Tensor, Tensor, Tensor
]  # observations, actions, lengths, window, as `WorldModel.init` takes them


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


def _some(starts: tuple[Tensor, ...], branch: Tensor) -> tuple[Tensor, ...]:
    """The arguments of `init` for these rollouts (B,) alone."""
    observations, actions, lengths, *window = starts
    if not window:
        return observations[branch], actions[branch], lengths[branch]
    used, window = window[0][branch].unique(return_inverse=True)
    return observations[used], actions[used], lengths[branch], window
