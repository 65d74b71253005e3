"""Are the predicted spreads honest? Central coverage of the one-step predictive Gaussian on held-out episodes."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from envtf_lit.world_models.horizon import Forecast, Scale, Trajectories

LEVELS = (0.5, 0.9)


@dataclass(frozen=True)
class Coverage:
    """Share of outcomes inside central predictive intervals.

    Attributes:
        level: of the interval, in (0, 1): what an honest model covers.
        mean: over live dimensions and the reward.
        by_dimension: one number for each observation dimension and, last, the reward; None for constant dimensions.
    """

    level: float
    mean: float
    by_dimension: tuple[float | None, ...]


def standardised_residuals(taught: Forecast, trajectories: Trajectories) -> Tensor:
    """(valid steps, S + 1) `(recorded - mean) / std` of a teacher-forced forecast; honest ones are standard normal.

    A predicted std of zero gives infinity, or zero where the prediction is exact.
    """
    error = (trajectories.targets - taught.mean)[trajectories.valid].double()
    std = taught.std[trajectories.valid].double()
    return torch.where(error == 0.0, error, error / std)


def coverage(taught: Forecast, trajectories: Trajectories, scale: Scale, level: float) -> Coverage:
    """Share of recorded outcomes inside the central `level` interval of each one-step prediction.

    Args:
        taught: the teacher-forced forecast of `horizon_report`.
        trajectories: what was forecast.
        scale: says which dimensions are live.
        level: in (0, 1).
    """
    half_width = math.sqrt(2.0) * float(torch.erfinv(torch.tensor(level, dtype=torch.float64)))
    share = (standardised_residuals(taught, trajectories).abs() <= half_width).double().mean(0)  # (S + 1,)
    live = scale.live.tolist()
    by_dimension = tuple(value if alive else None for value, alive in zip(share.tolist(), live, strict=True))
    return Coverage(level, float(share[scale.live].mean()), by_dimension)
