"""`reports/metrics.json`: the experiment in two dozen finite numbers."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from envtf_lit.data.cards import UNSCORED, counted_episodes, dataset_scores
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.evaluation.calibration import coverage
from envtf_lit.evaluation.horizon import HorizonReport
from envtf_lit.evaluation.offline import Promises
from envtf_lit.robots.returns import Returns
from envtf_lit.robots.tasks import Robot
from envtf_lit.world_models.forecast import Scale


def comparable(
    dataset: OfflineDataset, returns: Mapping[str, Returns], robot: Robot, source: str
) -> tuple[str, dict[str, np.ndarray]]:
    """The unit in which policies are compared with the data, and in it each one's episodes (E,), first the `data`'s.

    The unit is `score`, D4RL's, or `return` where the data are Minari's, whose sets D4RL's references do not belong to.
    """
    if source in UNSCORED:
        recorded = dataset.episode_returns[counted_episodes(dataset, source)]
        return "return", {"data": recorded} | {name: found.returns for name, found in returns.items()}
    scores = {name: found.scores for name, found in returns.items()}
    return "score", {"data": dataset_scores(dataset, robot, source)} | scores


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
    world_model: Mapping[str, Any],
    rollouts: int,
) -> dict[str, Any]:
    """What `reports/metrics.json` holds; standard deviations are over episodes, with n in the denominator.

    Args:
        returns: episodes of `bc`, `cql` and `et_cql`.
        task: name of the task.
        seed: of the experiment.
        dataset: the whole of it, held-out episodes included.
        source: of the dataset, as in `DownloadOptions`; there are no scores where it is Minari.
        robot: gives the scores their scale.
        world_model: of `world_model_metrics`.
        rollouts: imagined transitions stored by `generate_rollouts`.
    """
    unit, episodes = comparable(dataset, returns, robot, source)
    recorded, policy = episodes["data"], returns["et_cql"]
    found = {name: _spread(unit, episodes[name]) for name in returns}
    return {
        "task": task,
        "seed": seed,
        "dataset": {
            "transitions": len(dataset),
            "episodes": len(dataset.episode_starts),
            f"{unit}_mean": float(recorded.mean()),
            f"{unit}_max": float(recorded.max()),
        },
        "world_model": dict(world_model),
        "rollouts": {"transitions": rollouts},
        "policy": {
            **found.pop("et_cql"),
            **_spread("return", policy.returns),
            "episodes": len(policy.returns),
        },
        "baselines": found,
    }


def _spread(unit: str, values: np.ndarray) -> dict[str, float]:
    return {f"{unit}_mean": float(values.mean()), f"{unit}_std": float(values.std())}


def collect_promises(
    promises: Promises, *, seed: int, dataset: OfflineDataset, world_model: Mapping[str, Any], rollouts: int
) -> dict[str, Any]:
    """What `reports/metrics.json` holds for a robot without a simulator: no score, and no return that anyone measured.

    Args:
        promises: of `bc`, `cql` and `et_cql`.
        seed: of the experiment.
        dataset: the whole of it, held-out episodes included.
        world_model: of `world_model_metrics`.
        rollouts: imagined transitions stored by `generate_rollouts`.
    """
    policies = {
        name: {
            "imagined_return_mean": float(promise.returns.mean()),
            "imagined_return_std": float(promise.returns.std()),
            "action_error": promise.action_error,
        }
        for name, promise in promises.policies.items()
    }
    return {
        "task": None,
        "seed": seed,
        "dataset": {
            "transitions": len(dataset),
            "episodes": len(dataset.episode_starts),
            "return_mean": float(dataset.episode_returns.mean()),
            "return_max": float(dataset.episode_returns.max()),
        },
        "world_model": dict(world_model),
        "rollouts": {"transitions": rollouts},
        "held_out": {
            "episodes": len(promises.recorded),
            "return_mean": float(promises.recorded.mean()),
            "imagined_return_mean": float(promises.promised.mean()),
            "imagined_return_error": float(np.sqrt(np.square(promises.promised - promises.recorded).mean())),
        },
        "policy": policies.pop("et_cql"),
        "baselines": policies,
    }
