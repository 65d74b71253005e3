"""`reports/metrics.json`: the experiment in two dozen finite numbers."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from envtf_lit.data.cards import UNSCORED, counted_episodes, dataset_scores
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.evaluation.calibration import coverage
from envtf_lit.evaluation.horizon import HorizonReport
from envtf_lit.evaluation.offline import OfflineEstimates
from envtf_lit.robots.returns import Returns
from envtf_lit.robots.tasks import Robot
from envtf_lit.world_models.forecast import Scale


def comparable(
    dataset: OfflineDataset, returns: Mapping[str, Returns], robot: Robot, source: str
) -> tuple[str, np.ndarray, dict[str, np.ndarray]]:
    """The unit in which policies are compared with the data, and in it the data's episodes (E,) and each policy's.

    The unit is `score`, D4RL's, or `return` where the data are Minari's, whose sets D4RL's references do not belong to.
    """
    if source in UNSCORED:
        recorded = dataset.episode_returns[counted_episodes(dataset, source)]
        return "return", recorded, {name: found.returns for name, found in returns.items()}
    return "score", dataset_scores(dataset, robot, source), {name: found.scores for name, found in returns.items()}


def world_model_metrics(report: HorizonReport, scale: Scale, *, parameters: int) -> dict[str, Any]:
    """The world model's errors and calibration on held-out episodes.

    Args:
        report: of whole held-out episodes.
        scale: the training data's units.
        parameters: number of trainable parameters of the model.
    """
    covered = {
        level: coverage(report.teacher_forced_forecast, report.trajectories, scale, level).mean for level in (0.5, 0.9)
    }
    return {
        "parameters": parameters,
        "nmse_one_step": report.nmse_one_step,
        "coverage_50": covered[0.5],
        "coverage_90": covered[0.9],
        "open_loop_steps_0.01": report.open_loop[0.01].mean,
        "teacher_forced_steps_0.01": report.teacher_forced[0.01].mean,
    }


def collect_metrics(
    returns: Mapping[str, Returns],
    *,
    task: str,
    seed: int,
    dataset: OfflineDataset,
    source: str,
    robot: Robot,
    labels: Mapping[str, str],
    **facts: Any,
) -> dict[str, Any]:
    """What `reports/metrics.json` holds; standard deviations are over episodes, with n in the denominator.

    Args:
        returns: episodes of each policy, by name.
        task: name of the task.
        seed: of the experiment.
        dataset: the whole of it, held-out episodes included.
        source: of the dataset, as in `DownloadOptions`; there are no scores where it is Minari.
        robot: gives the scores their scale.
        labels: what to call each policy.
        facts: what else stands there: `world_model`, `rollouts` and `held_out`.
    """
    unit, recorded, episodes = comparable(dataset, returns, robot, source)
    policies = {
        name: {"label": labels[name]}
        | _spread(unit, episodes[name])
        | _spread("return", found.returns)
        | {"episodes": len(found.returns)}
        for name, found in returns.items()
    }
    known = {f"{unit}_mean": float(recorded.mean()), f"{unit}_max": float(recorded.max())}
    return {"task": task, "seed": seed, "dataset": _size(dataset) | known, **facts, "policies": policies}


def _size(dataset: OfflineDataset) -> dict[str, int]:
    return {"transitions": len(dataset), "episodes": len(dataset.episode_starts)}


def _spread(unit: str, values: np.ndarray) -> dict[str, float]:
    return {f"{unit}_mean": float(values.mean()), f"{unit}_std": float(values.std())}


def collect_offline_metrics(
    estimates: OfflineEstimates, *, seed: int, dataset: OfflineDataset, labels: Mapping[str, str], **facts: Any
) -> dict[str, Any]:
    """What `reports/metrics.json` holds for a robot without a simulator: no score, and no measured return.

    Args:
        estimates: of each policy.
        seed: of the experiment.
        dataset: the whole of it, held-out episodes included.
        labels: what to call each policy.
        facts: what else stands there: `world_model` and `rollouts`.
    """
    policies = {
        name: {"label": labels[name]}
        | _spread("imagined_return", estimate.returns)
        | {"action_error": estimate.action_error}
        for name, estimate in estimates.policies.items()
    }
    returns = dataset.episode_returns
    known = {"return_mean": float(returns.mean()), "return_max": float(returns.max())}
    return {
        "task": None,
        "seed": seed,
        "dataset": _size(dataset) | known,
        **facts,
        "held_out": held_out_metrics(estimates),
        "policies": policies,
    }


def held_out_metrics(estimates: OfflineEstimates) -> dict[str, float]:
    """What the model makes of recorded actions, beside what they earned: `held_out` in `reports/metrics.json`."""
    error = np.sqrt(np.square(estimates.imagined - estimates.recorded).mean())
    return {
        "episodes": len(estimates.recorded),
        "steps_mean": float(estimates.lengths.mean()),
        "return_mean": float(estimates.recorded.mean()),
        "imagined_return_mean": float(estimates.imagined.mean()),
        "imagined_return_error": float(error),
    }
