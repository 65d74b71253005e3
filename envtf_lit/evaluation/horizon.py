"""How long a world model's predictions stay right along held-out episodes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from envtf_lit.world_models.forecast import Forecast, Scale, Trajectories, forecast, nmse, steps_within
from envtf_lit.world_models.interface import WorldModel

THRESHOLDS = (0.01, 0.1)
HORIZONS = (1, 5, 10, 50, 100, 500, 1000)
EXPLODED = 10.0  # nmse beyond which a rollout has left anything that the data holds
FEWEST = 5  # trajectories that a quartile is drawn from
SMALLEST, LARGEST = 1e-8, 1e8  # curves of errors are drawn on a logarithmic axis, within these


@dataclass(frozen=True)
class Steps:
    """How many steps trajectories stay within an error threshold.

    Attributes:
        mean: restricted mean; a trajectory that ends within the threshold counts with its length.
        standard_error: of that mean.
        median: over trajectories.
        censored: share of trajectories that end within the threshold.
    """

    mean: float
    standard_error: float
    median: float
    censored: float

    @classmethod
    def within(cls, error: Tensor, lengths: Tensor, threshold: float) -> "Steps":
        """Of trajectories with these errors, as `steps_within` takes them."""
        steps, censored = steps_within(error, lengths, threshold)
        values = steps.double().cpu().numpy()
        spread = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
        return cls(float(values.mean()), float(spread), float(np.median(values)), float(censored.double().mean()))


def error_quartiles(error: Tensor, lengths: Tensor) -> dict[str, np.ndarray]:
    """Quartiles of the errors (B, T) by step, over the trajectories that last so long, while five or more do.

    Returns:
        Columns (H,) `step`, `lower`, `median`, `upper`, bounded to [1e-8, 1e8], and `trajectories`.
    """
    values, lasting = error.cpu().numpy(), lengths.cpu().numpy()
    last = int(np.sort(lasting)[-min(FEWEST, len(lasting))])
    quartiles, counts = np.empty((last, 3)), np.empty(last, np.int64)
    for h in range(1, last + 1):
        running = np.clip(values[lasting >= h, h - 1], SMALLEST, LARGEST)
        quartiles[h - 1], counts[h - 1] = np.quantile(running, (0.25, 0.5, 0.75)), len(running)
    lower, median, upper = quartiles.T
    return dict(step=np.arange(1, last + 1), lower=lower, median=median, upper=upper, trajectories=counts)


@dataclass(frozen=True, eq=False)
class HorizonReport:
    """Errors of a model along whole held-out episodes.

    Attributes:
        nmse_one_step: mean teacher-forced nmse over all steps.
        open_loop, teacher_forced: by threshold.
        median_nmse: open loop, by step h, over the trajectories that last so long.
        explosion_rate: share of trajectories whose open-loop nmse exceeds 10 or is not finite at some step.
        trajectories: what was forecast.
        open_loop_forecast, teacher_forced_forecast: of the trajectories.
        open_loop_nmse, teacher_forced_nmse: (B, T), meaningless in the padding.
    """

    nmse_one_step: float
    open_loop: dict[float, Steps]
    teacher_forced: dict[float, Steps]
    median_nmse: dict[int, float]
    explosion_rate: float
    trajectories: Trajectories
    open_loop_forecast: Forecast
    teacher_forced_forecast: Forecast
    open_loop_nmse: Tensor
    teacher_forced_nmse: Tensor

    @property
    def median_row(self) -> int:
        """The trajectory of median quality: by the steps within nmse 0.1, open loop."""
        within, _ = steps_within(self.open_loop_nmse, self.trajectories.lengths, 0.1)
        return int(within.argsort(stable=True)[(len(within) - 1) // 2])


def horizon_report(
    model: WorldModel, trajectories: Trajectories, scale: Scale, *, thresholds: Sequence[float] = THRESHOLDS
) -> HorizonReport:
    """Forecasts every trajectory open loop and teacher-forced and sums up the errors."""
    open_loop = forecast(model, trajectories, feedback="imagined")
    teacher_forced = forecast(model, trajectories, feedback="recorded")
    free, forced = (nmse(run.mean, trajectories, scale) for run in (open_loop, teacher_forced))
    lengths, valid = trajectories.lengths, trajectories.valid
    reached = [h for h in HORIZONS if bool((lengths >= h).any())]
    return HorizonReport(
        nmse_one_step=float(forced[valid].mean()),
        open_loop={threshold: Steps.within(free, lengths, threshold) for threshold in thresholds},
        teacher_forced={threshold: Steps.within(forced, lengths, threshold) for threshold in thresholds},
        median_nmse={h: float(np.median(free[lengths >= h, h - 1].cpu().numpy())) for h in reached},
        explosion_rate=float(((free > EXPLODED) & valid).any(1).double().mean()),
        trajectories=trajectories,
        open_loop_forecast=open_loop,
        teacher_forced_forecast=teacher_forced,
        open_loop_nmse=free,
        teacher_forced_nmse=forced,
    )
