"""Where datasets come from, and the card that says what one holds."""

import platform
from importlib.metadata import version
from typing import Any

import numpy as np

from envtf_lit.data.behaviour import collect, plan
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.formats import load_dataset
from envtf_lit.errors import UserError
from envtf_lit.params import DownloadOptions
from envtf_lit.tasks import Task, get_task

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def make_dataset(
    task: Task, options: DownloadOptions, *, seed: int, workers: int, progress: bool = True
) -> OfflineDataset:
    """The task's dataset from `options.source`.

    Args:
        task: robot and tier; of a file, only the robot must fit.
        options: the source, and what it needs.
        seed: of the zoo's environments and actions; a file has no use for it.
        workers: processes that collect; they do not change the result.
        progress: shows a bar with the time left.

    Raises:
        UserError: the zoo lacks the task, `options.path` is missing or not wanted, or the file is bad.
    """
    if options.source == "file":
        if options.path is None:
            raise UserError("download.source is file and download.path is empty: name the HDF5 or NPZ file there.")
        return load_dataset(options.path, task=task.name)
    if options.path is not None:
        raise UserError(
            f"download.path is {options.path} and download.source is zoo, which reads no file: set the source to file, "
            "or the path to null."
        )
    return collect(task, options.transitions, seed=seed, workers=workers, progress=progress)


def dataset_card(dataset: OfflineDataset, options: DownloadOptions, seed: int) -> dict[str, Any]:
    """What a dataset holds and how it came about, ready for JSON.

    Returns:
        task, source, transitions, episodes, terminated and truncated episodes, steps per episode, the distribution of
        episode returns, D4RL-normalised scores where the robot is known, and for the zoo its policies, environment,
        seed and package versions.
    """
    lengths = dataset.episode_lengths
    card: dict[str, Any] = {
        "task": dataset.task,
        "source": options.source,
        "transitions": len(dataset),
        "episodes": len(lengths),
        "terminated": int(dataset.terminated.sum()),
        "truncated": int((dataset.truncated & ~dataset.terminated).sum()),
        "episode_steps": {"min": int(lengths.min()), "mean": float(lengths.mean()), "max": int(lengths.max())},
        "returns": _distribution(dataset.episode_returns),
    }
    if dataset.task is not None:
        task = get_task(dataset.task)
        mean, best = dataset.episode_returns.mean(), dataset.episode_returns.max()
        card["scores"] = {name: task.robot.normalised_score(float(x)) for name, x in (("mean", mean), ("max", best))}
        card["env_id"] = task.robot.env_id
        if options.source == "zoo":
            card |= _provenance(task, options.transitions, seed)
    if options.source == "file":
        card["path"] = options.path
    return card


def _distribution(values: np.ndarray) -> dict[str, float]:
    quantiles = {f"quantile_{q:g}": float(np.quantile(values, q)) for q in QUANTILES}
    return {
        "mean": float(values.mean()),
        "std": float(values.std()),
        "min": float(values.min()),
        **quantiles,
        "max": float(values.max()),
    }


def _provenance(task: Task, transitions: int, seed: int) -> dict[str, Any]:
    policies = [
        {
            "policy": f"snapshot after {phase.steps} steps" if phase.steps else "uniform random (warm-up)",
            "steps": phase.steps,
            "transitions": phase.rows,
            "mean_return_deterministic": phase.mean_return,
        }
        for phase in plan(task, transitions)
    ]
    versions = {name: version(name) for name in ("gymnasium", "mujoco", "numpy", "torch")}
    return {
        "seed": seed,
        "actions": "stochastic",
        "policies": policies,
        "versions": {**versions, "python": platform.python_version()},
        "note": (
            f"Collected in {task.robot.env_id} by this package's own behaviour policies: these are not D4RL's files, "
            "and scores compare among themselves, not with D4RL's tables."
        ),
    }
