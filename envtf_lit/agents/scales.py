"""What an agent takes from its dataset: the scale of its networks' observations, and what returns are like there."""

import math
from dataclasses import dataclass
from typing import Any, Self

from torch import Tensor, nn

from envtf_lit.data.datamodules import TransitionData

EQUAL = 1e-3  # of a typical return, up to which a spread of returns is rounding, or as good as none


@dataclass(frozen=True)
class LogReturns:
    """The discounted returns to go of a log's rows, in its own rewards; before there is a log, of unit spread.

    Attributes:
        typical: their mean; see `loaders.Transitions`.
        spread: their standard deviation, above zero.
        largest: that any policy can have, `max |r| / (1 - discount)`.
    """

    typical: float = 0.0
    spread: float = 1.0
    largest: float = math.inf

    @classmethod
    def of(cls, data: TransitionData, discount: float) -> Self:
        """Those of a dataset's rows. Where all are alike, they have no spread but their size."""
        returns, typical = data.transitions.complete_returns(), data.transitions.typical_return
        spread = float(returns.std(correction=0))
        if spread <= EQUAL * abs(typical):
            spread = abs(typical) or 1.0
        return cls(typical, spread, float(abs(data.dataset.rewards).max()) / (1.0 - discount))


def scale_observations(module: nn.Module, mean: Tensor, std: Tensor) -> None:
    """Sets the observation scale (S,) of every network in a module that has one."""
    for inner in module.modules():
        if isinstance(getattr(inner, "observation_mean", None), Tensor):
            network: Any = inner
            network.observation_mean.copy_(mean)
            network.observation_std.copy_(std)
