"""What an agent takes from its dataset: the scale of its networks' observations, and what returns are like there."""

import math
from dataclasses import dataclass
from typing import Any, Self

from torch import Tensor, nn

from envtf_lit.data.datamodules import TransitionData
from envtf_lit.divergence import Bound

LOW = 0.05  # share of the rows whose returns are below `LogReturns.low`
EQUAL = 1e-3  # of a typical return, up to which a spread of returns is rounding, or as good as none
SLACK, ROUGH = 2.0, 1.0  # factor, and values of a network that has learned nothing yet, by which the bound is wide
VALUES = ("q_data", "q_target", "q_policy")  # logged means that are values, in units of the return scale


@dataclass(frozen=True)
class LogReturns:
    """The discounted returns to go of a log's rows, in its own rewards; before there is a log, of unit spread.

    Attributes:
        typical: their mean; see `loaders.Transitions`.
        spread: their standard deviation, above zero.
        low: that only one row in twenty falls short of.
        largest: that any policy can have, `max |r| / (1 - discount)`.
    """

    typical: float = 0.0
    spread: float = 1.0
    low: float = 0.0
    largest: float = math.inf

    @classmethod
    def of(cls, data: TransitionData, discount: float) -> Self:
        """Those of a dataset's rows. Where all are alike, they have no spread but their size."""
        returns, typical = data.transitions.complete_returns(), data.transitions.typical_return
        spread = float(returns.std(correction=0))
        if spread <= EQUAL * abs(typical):
            spread = abs(typical) or 1.0
        low = float(returns.kthvalue(max(1, round(LOW * len(returns)))).values)
        return cls(typical, spread, low, float(abs(data.dataset.rewards).max()) / (1.0 - discount))

    def bounds(self, scale: float) -> dict[str, Bound]:
        """What no policy's values can be, by their logged names, where returns are divided by `scale`.

        Upwards alone: conservative terms push values of unseen actions down as far as they like.
        """
        largest = self.largest / scale
        cause = f"where rewards allow {largest:.3g} (max |reward| / (1 - discount)), so values feed on themselves"
        return dict.fromkeys((f"train/{name}" for name in VALUES), Bound(SLACK * largest + ROUGH, cause))


def scale_observations(module: nn.Module, mean: Tensor, std: Tensor) -> None:
    """Sets the observation scale (S,) of every network in a module that has one."""
    for inner in module.modules():
        if isinstance(getattr(inner, "observation_mean", None), Tensor):
            network: Any = inner
            network.observation_mean.copy_(mean)
            network.observation_std.copy_(std)
