"""In-context error: a world model's error by the number of steps of the episode that it was shown.

Where a robot's dynamics are hidden, a model with memory errs less the more it has seen.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.world_models.forecast import Scale, Trajectories, forecast, nmse, segments
from envtf_lit.world_models.interface import WorldModel

CONTEXT = 32  # positions whose one-step error is measured: 0 to 31 steps of history
HISTORY, HORIZON = 16, 25  # the open loop's: steps seen before it, and its length
QUANTILES = (0.25, 0.5, 0.75)


@dataclass(frozen=True)
class InContextError:
    """Lower quartile, median and upper quartile of a model's errors (`world_models.forecast.nmse`) over stretches.

    Attributes:
        one_step: 3 curves of 32: one step ahead, the c-th after c steps of true history.
        open_loop: 3 curves of 25: after 1 to 25 steps of the model's own, begun after 16 steps of true history.
    """

    one_step: list[list[float]]
    open_loop: list[list[float]]

    @classmethod
    def of(cls, one_step: Tensor, open_loop: Tensor) -> "InContextError":
        """From the errors (N, 32) and (N, 25) of N stretches."""
        return cls(*(np.quantile(error.cpu().numpy(), QUANTILES, axis=0).tolist() for error in (one_step, open_loop)))

    @property
    def summary(self) -> tuple[float, float]:
        """The medians one step ahead after 16 steps of history, and at the 25th step of the open loop."""
        return self.one_step[1][HISTORY], self.open_loop[1][-1]


def stretches(dataset: OfflineDataset, count: int, *, seed: int) -> Trajectories:
    """Stretches of 41 steps, from rows drawn at random: the data that in-context errors are measured on.

    They start anywhere in an episode, so that a position in the stretch says how much a model has seen, and nothing of
    how long ago the robot was reset.

    Raises:
        UserError: no episode is long enough.
    """
    return segments(dataset, count, max(CONTEXT, HISTORY + HORIZON), seed=seed, whole=True)


def in_context_error(model: WorldModel, trajectories: Trajectories, scale: Scale) -> InContextError:
    """The errors of a model on what `stretches` gives, which is on the model's device."""
    forced = forecast(model, trajectories, feedback="recorded")
    free = forecast(model, trajectories, feedback="imagined", history=HISTORY)
    one_step, open_loop = (nmse(run.mean, trajectories, scale) for run in (forced, free))
    return InContextError.of(one_step[:, :CONTEXT], open_loop[:, HISTORY : HISTORY + HORIZON])


def in_context_metrics(found: Mapping[str, InContextError]) -> dict[str, Any]:
    """Medians over the stretches, by `model.metric`, and the transformer's as a share of every other model's.

    `one_step` is after 16 steps of history, `open_loop` at the 25th step of a model's own after them; `…_by_context`
    and `…_by_step` are the whole curves.
    """
    metrics: dict[str, Any] = {}
    for name, errors in found.items():
        metrics[f"{name}.one_step"], metrics[f"{name}.open_loop"] = errors.summary
        metrics[f"{name}.one_step_by_context"] = errors.one_step[1]
        metrics[f"{name}.open_loop_by_step"] = errors.open_loop[1]
    for name in (name for name in found if name != "transformer"):
        for kind in ("one_step", "open_loop"):
            metrics[f"transformer.{kind}_vs_{name}"] = metrics[f"transformer.{kind}"] / metrics[f"{name}.{kind}"]
    return metrics


@dataclass(frozen=True)
class Doubt:
    """How wrong a model is one step ahead, and how wrong it says that it is, by the steps of history it was shown.

    Attributes:
        error: (T,) root mean square over stretches and live dimensions of the error, in standard deviations.
        told: (T,) likewise of the predicted standard deviation; equal to `error` where the model knows its errors.
    """

    error: np.ndarray
    told: np.ndarray


def doubt_by_history(model: WorldModel, trajectories: Trajectories, scale: Scale) -> Doubt:
    """A model's errors and predicted spreads one step ahead, with all of a stretch's true history.

    Args:
        model: in eval mode, on the trajectories' device.
        trajectories: all of the same length, as of `stretches`.
        scale: the units.
    """
    found = forecast(model, trajectories, feedback="recorded")
    error = nmse(found.mean, trajectories, scale)
    told = (found.std / scale.std)[..., scale.live].double().square().mean(-1)
    return Doubt(*(column.mean(0).sqrt().cpu().numpy() for column in (error, told)))


def errors_on_the_way(model: WorldModel, trajectories: Trajectories, scale: Scale) -> np.ndarray:
    """(3, T) quartiles over episodes of the error one step ahead (nmse), at each step of episodes of equal length."""
    error = nmse(forecast(model, trajectories, feedback="recorded").mean, trajectories, scale)
    return np.quantile(error.cpu().numpy(), QUANTILES, axis=0)


def steps_to_settle(errors: np.ndarray, at: int, *, within: float = 1.5) -> int | None:
    """Steps after `at` until a curve of errors (T,) first is within a factor of where it ends; None: it never is.

    Where it ends is the median of its last quarter after `at`.
    """
    after = errors[at:]
    settled = np.flatnonzero(after <= within * np.median(after[-max(1, len(after) // 4) :]))
    return int(settled[0]) if len(settled) else None
