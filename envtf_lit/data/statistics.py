"""Means, standard deviations and ranges of a dataset's columns, from which every scale in the package comes."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from envtf_lit.data.columns import column_blocks

if TYPE_CHECKING:
    from envtf_lit.data.dataset import OfflineDataset

# of its largest magnitude: a dimension whose standard deviation is no more is constant, about ten steps of float32
CONSTANT = 1e-6
SMALLEST = torch.finfo(torch.float32).tiny  # below it float32 has no digits left


@dataclass(frozen=True, eq=False)
class Moments:
    """Statistics of D dimensions over rows, each in the dimension's own unit.

    Attributes:
        mean, std: (D,) float64; the standard deviation has n in the denominator.
        low, high: (D,) float64, least and greatest value.
    """

    mean: Tensor
    std: Tensor
    low: Tensor
    high: Tensor

    @classmethod
    def of(cls, parts: Iterable[Tensor]) -> "Moments":
        """Over the rows of all parts (n, D), of which there is at least one.

        Parts are merged by Chan, Golub & LeVeque (1983), so that mean and std depend on where they are cut in their
        last bits alone; columns are always cut by `blocks`, wherever they lie.
        """
        count, mean, variance, low, high = 0, *(torch.zeros(()),) * 4
        for part in parts:
            new_variance, new_mean = torch.var_mean(part.double(), dim=0, correction=0)
            least, most = (extreme.double() for extreme in part.aminmax(dim=0))
            if count == 0:
                count, mean, variance, low, high = len(part), new_mean, new_variance, least, most
                continue
            share = len(part) / (count + len(part))
            shift = new_mean - mean
            variance = variance + share * (new_variance - variance) + share * (1 - share) * shift.square()
            mean, count = mean + share * shift, count + len(part)
            low, high = torch.minimum(low, least), torch.maximum(high, most)
        return cls(mean, variance.sqrt(), low, high)

    @property
    def live(self) -> Tensor:
        """(D,) bool, False for constant dimensions: whose std is at most `CONSTANT` of their largest magnitude.

        No unit enters: a column in metres and the same one in micrometres are both live, or neither.
        """
        return (self.std > CONSTANT * self.largest) & (self.std > SMALLEST)

    @property
    def scale(self) -> Tensor:
        """(D,) float64, what z-scores divide by: the std; of a constant dimension its magnitude, or 1 if it is 0."""
        return torch.where(self.live, self.std, torch.where(self.largest > SMALLEST, self.largest, 1.0))

    @property
    def largest(self) -> Tensor:
        """(D,) float64, the largest magnitude."""
        return torch.maximum(self.low.abs(), self.high.abs())

    def __getitem__(self, dimensions: slice) -> "Moments":
        """Those of some dimensions."""
        return Moments(*(values[dimensions] for values in (self.mean, self.std, self.low, self.high)))

    def __add__(self, other: "Moments") -> "Moments":
        """These dimensions, and the other's after them."""
        pairs = ((self.mean, other.mean), (self.std, other.std), (self.low, other.low), (self.high, other.high))
        return Moments(*(torch.cat(pair) for pair in pairs))


class DatasetStatistics:
    """`Moments` of a dataset with S observation and A action dimensions; each is computed once, when first asked for.

    Args:
        dataset: read in blocks, so that a column that stays in its file never lies in memory whole.
    """

    def __init__(self, dataset: "OfflineDataset") -> None:
        self._dataset = dataset

    @cached_property
    def observations(self) -> Moments:
        """(S,)"""
        return self._over(lambda rows: torch.as_tensor(self._dataset.observations[rows]))

    @cached_property
    def actions(self) -> Moments:
        """(A,)"""
        return self._over(lambda rows: torch.as_tensor(self._dataset.actions[rows]))

    @cached_property
    def outcomes(self) -> Moments:
        """(S + 1,) of next observations and, last, the reward."""
        return self._over(self._outcomes)

    @cached_property
    def changes(self) -> Moments:
        """(S + 1,) of `s' - s`, taken in float32, and, last, the reward."""

        def change(rows: slice) -> Tensor:
            outcome = self._outcomes(rows)
            outcome[:, :-1] -= torch.as_tensor(self._dataset.observations[rows])
            return outcome

        return self._over(change)

    @property
    def next_observations(self) -> Moments:
        """(S,)"""
        return self.outcomes[:-1]

    @property
    def rewards(self) -> Moments:
        """(1,)"""
        return self.outcomes[-1:]

    def _outcomes(self, rows: slice) -> Tensor:
        following, rewards = self._dataset.next_observations[rows], self._dataset.rewards[rows]
        return torch.cat([torch.as_tensor(following), torch.as_tensor(rewards)[:, None]], dim=-1)

    def _over(self, values: Callable[[slice], Tensor]) -> Moments:
        return Moments.of(map(values, column_blocks(self._dataset.observations)))
