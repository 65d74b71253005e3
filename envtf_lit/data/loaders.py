"""Lightning data modules and the datasets below them: windows for world models, transitions for agents.

A batch is a draw of row numbers. Columns lie on the device as tensors if they fit there; those of a large file stay in
it. The batches are the same to the bit. Every epoch draws from a generator seeded by (seed, epoch), so a run resumed at
an epoch's start sees the same rows as one that was never interrupted.
"""

import copy
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from envtf_lit.data.columns import Column, FileRows, column_blocks
from envtf_lit.data.dataset import OfflineDataset

BISECTIONS = 30  # of a temperature


def epoch_generator(seed: int, epoch: int, stream: str, device: torch.device | str = "cpu") -> torch.Generator:
    """An independent random stream for each (seed, epoch, purpose), of numbers drawn on that device."""
    words = np.random.SeedSequence([seed, epoch, *stream.encode()]).generate_state(2, np.uint32)
    return torch.Generator(device).manual_seed(int(words[0]) << 32 | int(words[1]))


class WeightedRows:
    """Draws row numbers with given chances: a table of cumulative chances, searched.

    Args:
        weights: (N,) chances of each row, up to a factor.
        device: where the table lies and the numbers are drawn.
    """

    def __init__(self, weights: Tensor, device: torch.device | str = "cpu") -> None:
        self.cumulative = (weights.double().cumsum(0) / weights.double().sum()).to(device)  # (N,)

    def draw(self, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
        """Row numbers of this shape; `generator` is on the table's device."""
        uniform = torch.rand(shape, generator=generator, device=self.cumulative.device, dtype=torch.float64)
        return torch.searchsorted(self.cumulative, uniform).clamp(max=len(self.cumulative) - 1)

    def chances(self, rows: Tensor) -> Tensor:
        """The chance of each of these rows (...), float64."""
        before = torch.where(rows > 0, self.cumulative[(rows - 1).clamp(min=0)], 0.0)
        return self.cumulative[rows] - before


class DrawSampler(Sampler[Tensor]):
    """Yields `batches` tensors of draws from [0, rows), of shape `shape`, anew in each epoch.

    Args:
        rows: number of rows.
        shape: of each draw.
        batches: draws per epoch.
        seed: with the epoch, names the random stream.
        weights: (rows,) chances of each row, up to a factor; None draws uniformly.
        process: which one this is, of how many. All draw the same numbers, of a shape whose last axis is so many times
            as long, and each takes its own share of that axis.
    """

    def __init__(
        self,
        rows: int,
        shape: tuple[int, ...],
        batches: int,
        *,
        seed: int,
        weights: Tensor | None = None,
        process: tuple[int, int] = (0, 1),
    ) -> None:
        rank, world = process
        self.rows, self.batches, self.seed, self.epoch = rows, batches, seed, 0
        self.shape, self.share = (*shape[:-1], world * shape[-1]), slice(rank * shape[-1], (rank + 1) * shape[-1])
        self.weighted = None if weights is None else WeightedRows(weights)

    def set_epoch(self, epoch: int) -> None:
        """Called by Lightning before each epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        return self.batches

    def __iter__(self) -> Iterator[Tensor]:
        generator = epoch_generator(self.seed, self.epoch, "rows")
        for _ in range(self.batches):
            if self.weighted is None:
                drawn = torch.randint(self.rows, self.shape, generator=generator)
            else:
                drawn = self.weighted.draw(self.shape, generator)
            yield drawn[..., self.share]


@dataclass(frozen=True)
class ReturnWeights:
    """`exp(R / temperature)`, R the row's episode return scaled to [0, 1] (Hong et al. 2023).

    A log that is mostly poor then teaches what its best episodes did; a small temperature means a sharp preference.

    Attributes:
        lowest, spread: of the episodes' returns that are scaled; a spread of 1 where all are equal.
        inverse: of the temperature.
    """

    lowest: float
    spread: float
    inverse: float

    @classmethod
    def of(cls, dataset: OfflineDataset, temperature: float, fewest_episodes: int = 1) -> Self:
        """The weights of a dataset's rows.

        Args:
            dataset: whose rows.
            temperature: raised as far as it must be for rows to come from enough episodes.
            fewest_episodes: effective number of episodes (`effective_episodes`) that rows come from, or as many as
                equal chances give.
        """
        returns, even = dataset.episode_returns, torch.ones(len(dataset))
        scale = float(returns.min()), float(np.ptp(returns)) or 1.0

        def enough(inverse: float) -> bool:
            return effective_episodes(dataset, cls(*scale, inverse)(dataset)) >= floor

        floor = min(float(fewest_episodes), effective_episodes(dataset, even))
        low, high = 0.0, 1.0 / temperature  # of the inverse: equal chances are enough
        if enough(high):
            return cls(*scale, high)
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if enough(middle) else (low, middle)
        return cls(*scale, low)

    def __call__(self, dataset: OfflineDataset) -> Tensor:
        """(N,) weights of the rows of this dataset or of another, such as what was held out of it."""
        scaled = (dataset.episode_returns - self.lowest) / self.spread
        return torch.as_tensor(np.exp((scaled.clip(0.0, 1.0) - 1.0) * self.inverse)[dataset.episode_index])


def effective_episodes(dataset: OfflineDataset, weights: Tensor) -> float:
    """`(sum_e p_e)^2 / sum_e p_e^2`, p_e the chance that a row drawn by weights (N,) is of episode e (Kish 1965)."""
    chances = np.add.reduceat(weights.double().numpy(), dataset.episode_starts)
    return float(chances.sum() ** 2 / np.square(chances).sum())


class Store:
    """Columns of a dataset, to gather rows from.

    Args:
        dataset: whose columns.
        names: of the columns.
        device: where gathered rows go, and where the columns themselves go if they fit into half of its free memory.
            On the CPU all columns stay where they are, which for a large dataset is its file.
    """

    def __init__(self, dataset: OfflineDataset, names: Iterable[str], device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)
        columns: dict[str, Column] = {name: getattr(dataset, name) for name in names}
        resident = _fits(sum(column.nbytes for column in columns.values()), self.device)
        self.columns = {name: _place(column, self.device, resident) for name, column in columns.items()}

    def only(self, *names: str) -> "Store":
        """The same columns, in the same place, but no others."""
        store = copy.copy(self)
        store.columns = {name: self.columns[name] for name in names}
        return store

    def __getitem__(self, rows: Tensor) -> dict[str, Tensor]:
        """Row numbers (...) on any device to each column's rows (..., D) on the store's."""
        return {name: self._gather(column, rows) for name, column in self.columns.items()}

    def _gather(self, column: Tensor | FileRows, rows: Tensor) -> Tensor:
        if isinstance(column, FileRows):
            return torch.from_numpy(column[rows.cpu().numpy()]).to(self.device)
        return column[rows.to(column.device)].to(self.device)


def _fits(size: int, device: torch.device) -> bool:
    if device.type == "cpu":
        return False
    memory = getattr(torch.get_device_module(device), "mem_get_info", None)
    return memory is not None and size < memory(device)[0] // 2


def _place(column: Column, device: torch.device, resident: bool) -> Tensor | FileRows:
    if not resident:
        return column if isinstance(column, FileRows) else torch.as_tensor(column)
    placed = torch.empty(column.shape, dtype=torch.as_tensor(column[:0]).dtype, device=device)
    for block in column_blocks(column):
        placed[block] = torch.as_tensor(column[block]).to(device)
    return placed


class Windows(Dataset[dict[str, Tensor]]):
    """Windows of up to T consecutive steps that never cross an episode.

    Indexed by a tensor of window numbers of any shape. An episode of L steps has L + T - 1 windows, those that overlap
    it by at least one step, so that each row is seen equally often: the first token of a rollout must be learned too.
    What sticks out on either side is cut, and the rest is moved to the left and padded on the right.
    """

    def __init__(self, dataset: OfflineDataset, length: int, device: torch.device | str = "cpu") -> None:
        self.length = length
        self.store = Store(dataset, ("observations", "actions", "rewards", "next_observations"), device)
        self.starts = torch.as_tensor(dataset.episode_starts, device=device)  # (E,)
        self.ends = torch.as_tensor(dataset.episode_ends, device=device)
        self.offsets = torch.cumsum(self.ends - self.starts + length - 1, 0)  # (E,) windows up to each episode's last

    def __len__(self) -> int:
        return int(self.offsets[-1])

    def __getitem__(self, windows: Tensor) -> dict[str, Tensor]:
        windows = windows.to(self.offsets.device)
        episode = torch.searchsorted(self.offsets, windows, right=True)
        begin = self.ends[episode] - (self.offsets[episode] - windows)  # may lie before the episode
        start = torch.maximum(begin, self.starts[episode])
        end = torch.minimum(begin + self.length, self.ends[episode])
        index = start[..., None] + torch.arange(self.length, device=start.device)  # (..., T)
        mask = index < end[..., None]
        index = torch.minimum(index, end[..., None] - 1)
        return self.store[index] | {"mask": mask.float()}

    def tiles(self) -> Tensor:
        """Window numbers that cover each row exactly once: consecutive windows of every episode."""
        lengths, offsets = (self.ends - self.starts).cpu(), self.offsets.cpu()
        count = (lengths + self.length - 1) // self.length  # (E,)
        episode = torch.repeat_interleave(torch.arange(len(lengths)), count)
        position = torch.arange(len(episode)) - torch.repeat_interleave(count.cumsum(0) - count, count)
        return (offsets - lengths)[episode] + position * self.length


class Resamples(Dataset[dict[str, Tensor]]):
    """Bootstrap resamples of windows: as many draws with replacement as there are windows, for each of M members.

    A single member (M = 1) is given every window once. Indexed by (M, B) positions, row m within the resample of
    member m.
    """

    def __init__(self, windows: Windows, members: int, *, seed: int) -> None:
        self.windows = windows
        generator = epoch_generator(seed, 0, "bootstrap")
        self.drawn = torch.randint(len(windows), (members, len(windows)), generator=generator)  # (M, N)
        if members == 1:
            self.drawn = torch.arange(len(windows))[None]

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, positions: Tensor) -> dict[str, Tensor]:
        return self.windows[torch.take_along_dim(self.drawn, positions, 1)]


class Transitions(Dataset[dict[str, Tensor]]):
    """Transitions of n steps with their Monte-Carlo return to go, indexed by a tensor of rows of any shape.

    Columns: `observations`, `actions`, `rewards` (discounted sum over the n steps, or as many as the episode has
    left), `next_observations` (where those steps end), `discounts` (`discount ** steps`, zero if the task terminated
    there: what the value of `next_observations` counts for), `next_actions` (recorded there) and `followed` (whether
    any was: 0 where the episode ends); `following_observations` (after one step alone); `returns` (discounted sum over
    all steps that the episode has left), `last_observations` (where it ends) and `tails` (what the value there counts
    for, likewise: a return that the log cut short is `returns + tails * V(last_observations)`).

    Attributes:
        typical_return: mean discounted return of the rows, `mean(returns) / (1 - mean(tails))`: that for which
            truncated episodes go on as rows do on average.
    """

    def __init__(
        self, dataset: OfflineDataset, *, discount: float, n_step: int = 1, device: torch.device | str = "cpu"
    ) -> None:
        last = np.repeat(dataset.episode_ends, dataset.episode_lengths) - 1  # (N,) last row of each row's episode
        rows = np.arange(len(dataset))
        end = np.minimum(rows + n_step - 1, last)
        rewards = np.zeros(len(dataset))
        for k in range(n_step):
            rewards += np.where(rows + k <= end, discount**k * dataset.rewards[np.minimum(rows + k, last)], 0.0)
        discounts, tails = (discount ** (row - rows + 1.0) * ~dataset.terminated[row] for row in (end, last))
        returns = dataset.returns_to_go(discount)
        self.typical_return = float(returns.mean(dtype=np.float64) / (1.0 - tails.mean()))
        self.states = Store(dataset, ("observations", "actions"), device)
        self.actions = self.states.only("actions")
        self.following = Store(dataset, ("next_observations",), device)
        columns = dict(rewards=rewards, discounts=discounts, returns=returns, tails=tails, followed=end < last)
        self.columns = {name: torch.as_tensor(column).float().to(device) for name, column in columns.items()}
        # (N,) the rows in which the n steps of each row end, and its episode; and the row behind the n steps
        self.end, self.last = torch.as_tensor(end, device=device), torch.as_tensor(last, device=device)
        self.after = torch.minimum(self.end + 1, self.last)

    def __len__(self) -> int:
        return len(self.end)

    def __getitem__(self, rows: Tensor) -> dict[str, Tensor]:
        rows = rows.to(self.end.device)
        ends = dict(next_observations=self.end[rows], following_observations=rows, last_observations=self.last[rows])
        following = {name: self.following[row]["next_observations"] for name, row in ends.items()}
        following["next_actions"] = self.actions[self.after[rows]]["actions"]
        return self.states[rows] | following | {name: column[rows] for name, column in self.columns.items()}

    def complete_returns(self) -> Tensor:
        """(N,) returns to go in which truncated episodes go on at the `typical_return`."""
        return self.columns["returns"] + self.columns["tails"] * self.typical_return


class DrawnRows:
    """Rows of a log drawn at random.

    Args:
        transitions: the rows.
        weights: (N,) chances of each row, up to a factor; None draws uniformly.
        device: where the rows lie.
    """

    def __init__(
        self, transitions: Transitions, weights: Tensor | None = None, device: torch.device | str = "cpu"
    ) -> None:
        self.transitions = transitions
        self.rows = WeightedRows(torch.ones(len(transitions)) if weights is None else weights, device)

    def draw(self, count: int, generator: torch.Generator) -> dict[str, Tensor]:
        """The columns of `Transitions`, (count, …); `generator` is on the device."""
        return self.transitions[self.rows.draw((count,), generator)]
