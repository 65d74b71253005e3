"""Tracking: how long a world model's forecasts stay near what really happened, on episodes it was not trained on.

The metric is the paper's (its section on long-horizon rollouts), made definite: see docs/metrics.md.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.evaluation.horizon import EXPLODED, LARGEST, THRESHOLDS, Steps, error_quartiles, horizon_report
from envtf_lit.evaluation.physics import Ceiling
from envtf_lit.robots.tasks import Task
from envtf_lit.robots.termination import never_terminated
from envtf_lit.world_models.forecast import Scale, Trajectories, forecast, nmse
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.zoo.collect import collect

PROBE = 10_000  # rows that tell how long episodes are
CURVE = np.unique(np.geomspace(1, 1000, 150).round().astype(int))  # the steps that curves are kept at


def fresh_episodes(task: Task, count: int, *, seed: int, workers: int = 1, progress: bool = False) -> OfflineDataset:
    """`count` whole episodes of a task's behaviour policies: until the fall or the time limit, not cut short.

    Args:
        task: robot and tier; the tier `expert` is the zoo's best policy alone.
        count: episodes.
        seed: another one than the training data's.
        workers: processes; they do not change the episodes.
        progress: shows bars.
    """
    limit, rows = task.robot.max_episode_steps, PROBE
    while True:
        dataset = collect(task, rows, seed=seed, workers=workers, progress=progress)
        whole = np.flatnonzero(dataset.finished(limit))
        if len(whole) >= count:
            return dataset.select(np.sort(np.random.default_rng(seed).permutation(whole)[:count]))
        typical = min(rows / max(len(whole), 1), limit)  # rows for each
        rows = max(2 * rows, math.ceil(1.1 * count * typical))


@dataclass(frozen=True)
class Tracking:
    """Numbers and curves of one model on one set of episodes.

    Attributes:
        numbers: by name; docs/metrics.md explains them.
        curves: by run (`open_loop`, `teacher_forced`, `ceiling`, `ceiling_typical`): columns of `error_quartiles`, at
            some steps.
    """

    numbers: dict[str, float]
    curves: dict[str, dict[str, list[float]]] = field(default_factory=dict)

    def __or__(self, other: "Tracking") -> "Tracking":
        return Tracking(self.numbers | other.numbers, self.curves | other.curves)


def track(
    model: WorldModel,
    trajectories: Trajectories,
    scale: Scale,
    terminated: Callable[[Tensor], Tensor] = never_terminated,
) -> Tracking:
    """Open-loop and teacher-forced lengths, with mean predictions from the first recorded state alone.

    Args:
        model: any world model, in eval mode, on the trajectories' device.
        trajectories: what really happened.
        scale: of errors.
        terminated: the robot's rule, of next observations (..., S).
    """
    report, lengths = horizon_report(model, trajectories, scale), trajectories.lengths
    teacher_forced = report.teacher_forced_nmse
    numbers = {
        "trajectories": len(lengths),
        "mean_length": float(lengths.double().mean()),
        "one_step_nrmse": math.sqrt(min(report.nmse_one_step, LARGEST)),
        "one_step_typical": math.sqrt(min(float(teacher_forced[trajectories.valid].median()), LARGEST)),
        **_explosions(report.open_loop_nmse, trajectories, report.open_loop_forecast.mean, terminated),
        **_numbers("open_loop", report.open_loop),
        **_numbers("teacher_forced", report.teacher_forced),
        **{f"open_loop_nmse_at_{h}": min(value, LARGEST) for h, value in report.median_nmse.items()},
    }
    errors = {"open_loop": report.open_loop_nmse, "teacher_forced": teacher_forced}
    return Tracking(numbers, {run: _curve(error, lengths) for run, error in errors.items()})


def _explosions(
    error: Tensor, trajectories: Trajectories, outcomes: Tensor, terminated: Callable[[Tensor], Tensor]
) -> dict[str, float]:
    """Share of trajectories that explode, and that do before the robot of these outcomes falls, as imagination ends."""
    exploded = (error > EXPLODED) & trajectories.valid  # (B, T)
    standing = exploded & ~terminated(outcomes[..., :-1]).int().cummax(1).values.bool()
    rates = (("explosion_rate", exploded), ("explosion_rate_standing", standing))
    return {name: float(steps.any(1).double().mean()) for name, steps in rates}


def track_sampled(model: WorldModel, trajectories: Trajectories, scale: Scale, *, seed: int) -> Tracking:
    """Open-loop lengths when each next state is drawn from the predictive distribution."""
    generator = torch.Generator(trajectories.actions.device).manual_seed(seed)
    drawn = forecast(model, trajectories, feedback="imagined", mode="sample", generator=generator)
    error = nmse(drawn.mean, trajectories, scale)
    found = {threshold: Steps.within(error, trajectories.lengths, threshold) for threshold in THRESHOLDS}
    return Tracking(_numbers("sampled_open_loop", found))


def track_ceiling(name: str, found: Ceiling, terminated: Callable[[Tensor], Tensor] = never_terminated) -> Tracking:
    """A physics ceiling as numbers and a curve of that name; `terminated` is the robot's rule, as in `track`."""
    exploded = _explosions(found.error, found.trajectories, found.outcomes, terminated)
    numbers = _numbers(name, found.steps) | {f"{name}_{rate}": value for rate, value in exploded.items()}
    return Tracking(numbers, {name: _curve(found.error, found.trajectories.lengths)})


def _numbers(name: str, by_threshold: Mapping[float, Steps]) -> dict[str, float]:
    numbers = {}
    for threshold, steps in by_threshold.items():
        numbers[f"{name}_{threshold:g}"] = steps.mean
        for detail in ("standard_error", "median", "censored"):
            numbers[f"{name}_{threshold:g}_{detail}"] = getattr(steps, detail)
    return numbers


def _curve(error: Tensor, lengths: Tensor) -> dict[str, Any]:
    columns = error_quartiles(error, lengths)
    kept = np.isin(columns["step"], CURVE)
    return {name: values[kept].tolist() for name, values in columns.items()}
