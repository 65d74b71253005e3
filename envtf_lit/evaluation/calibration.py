"""Are the predicted spreads honest? Central coverage of the one-step predictive Gaussian on held-out episodes."""

from dataclasses import dataclass

from envtf_lit.world_models.horizon import Forecast, Scale, Trajectories
from envtf_lit.world_models.recalibration import half_width, standardised_residuals

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


def coverage(taught: Forecast, trajectories: Trajectories, scale: Scale, level: float) -> Coverage:
    """Share of recorded outcomes inside the central `level` interval of each one-step prediction.

    Args:
        taught: the teacher-forced forecast of `horizon_report`.
        trajectories: what was forecast.
        scale: says which dimensions are live.
        level: in (0, 1).
    """
    share = (standardised_residuals(taught, trajectories).abs() <= half_width(level)).double().mean(0)  # (S + 1,)
    live = scale.live.tolist()
    by_dimension = tuple(value if alive else None for value, alive in zip(share.tolist(), live, strict=True))
    return Coverage(level, float(share[scale.live].mean()), by_dimension)
