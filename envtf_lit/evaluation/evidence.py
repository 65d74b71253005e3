"""`reports/metrics.json`: the experiment in two dozen finite numbers."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.evaluation.calibration import coverage
from envtf_lit.evaluation.offline import Promises
from envtf_lit.evaluation.returns import Returns
from envtf_lit.tasks import Robot
from envtf_lit.world_models.horizon import HorizonReport, Scale


def dataset_scores(dataset: OfflineDataset, robot: Robot) -> np.ndarray:
    """(E,) D4RL-normalised score of each recorded episode."""
    return np.array([robot.normalised_score(value) for value in dataset.episode_returns])


def world_model_metrics(report: HorizonReport, scale: Scale, *, parameters: int) -> dict[str, Any]:
    """The world model's errors and calibration on held-out episodes.

    Args:
        report: of whole held-out episodes.
        scale: the training data's units.
        parameters: number of trainable parameters of the model.
    """
    covered = {level: coverage(report.taught, report.trajectories, scale, level).mean for level in (0.5, 0.9)}
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
        robot: gives the scores their scale.
        world_model: of `world_model_metrics`.
        rollouts: imagined transitions stored by `generate_rollouts`.
    """
    recorded, policy = dataset_scores(dataset, robot), returns["et_cql"]
    return {
        "task": task,
        "seed": seed,
        "dataset": {
            "transitions": len(dataset),
            "episodes": len(recorded),
            "score_mean": float(recorded.mean()),
            "score_max": float(recorded.max()),
        },
        "world_model": dict(world_model),
        "rollouts": {"transitions": rollouts},
        "policy": {
            **_score(policy),
            "return_mean": float(policy.returns.mean()),
            "return_std": float(policy.returns.std()),
            "episodes": len(policy.returns),
        },
        "baselines": {name: _score(found) for name, found in returns.items() if name != "et_cql"},
    }


def _score(returns: Returns) -> dict[str, float]:
    return {"score_mean": float(returns.scores.mean()), "score_std": float(returns.scores.std())}


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
