"""Every check a dataset passes once, on its way in: what comes out is complete, finite and consistent."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from envtf_lit.data.dataset import COLUMNS, OfflineDataset, starts_from_ends
from envtf_lit.errors import UserError
from envtf_lit.tasks import TASKS, Task, get_task

RANKS = {"observations": 2, "actions": 2, "rewards": 1, "next_observations": 2, "terminated": 1, "truncated": 1}
FLAGS = ("terminated", "truncated")
NEEDED = ("observations", "actions", "rewards", "terminated", "truncated")
ACTION_TOLERANCE = 1e-5


def build_dataset(
    columns: Mapping[str, np.ndarray], attributes: Mapping[str, Any], *, task: str | None, source: str
) -> OfflineDataset:
    """Checks columns as read from a file and makes the dataset.

    Args:
        columns: by the names of `COLUMNS`; `next_observations` may be missing.
        attributes: `task`, `action_low`, `action_high`, each optional.
        task: overrides the name in `attributes`.
        source: what to call the data in messages.

    Raises:
        UserError: see `load_dataset`.
    """
    _check_shapes(columns, source)
    data = {name: _convert(name, values, source) for name, values in columns.items()}
    data = _close_episodes(data)
    known = _find_task(task, attributes.get("task"), source)
    _check_robot(data, known, source)
    low, high = _action_limits(attributes, known, data["actions"].shape[1], source)
    data["actions"] = _inside(data["actions"], low, high, source)
    starts = starts_from_ends(data["terminated"] | data["truncated"])
    complete = "next_observations" in data
    _check_lengths(starts, len(data["rewards"]), source, least=2 if complete else 3)
    if not complete:
        data, starts = _shift(data, starts)
    return OfflineDataset(
        **data,
        episode_starts=starts,
        action_low=low,
        action_high=high,
        task=known.name if known else None,
    )


def _check_shapes(columns: Mapping[str, np.ndarray], source: str) -> None:
    for name in NEEDED:
        if name not in columns:
            extra = {"terminated": " (or 'terminals')", "truncated": " (or 'timeouts')"}.get(name, "")
            raise UserError(f"{source} has no {name!r}{extra}: a dataset needs {', '.join(NEEDED)}.")
    for name, values in columns.items():
        if values.ndim != RANKS[name]:
            want = "(N, dimensions)" if RANKS[name] == 2 else "(N,)"
            raise UserError(f"{source}: {name!r} has shape {values.shape}: reshape it to {want}.")
    rows = len(columns["rewards"])
    for name, values in columns.items():
        if len(values) != rows:
            raise UserError(
                f"{source}: {name!r} has {len(values)} rows and 'rewards' has {rows}: write all columns equally long."
            )
        if 0 in values.shape:
            raise UserError(f"{source}: {name!r} has shape {values.shape}, which is empty: collect some transitions.")
    successors = columns.get("next_observations")
    if successors is not None and successors.shape != columns["observations"].shape:
        raise UserError(
            f"{source}: 'next_observations' has shape {successors.shape} and 'observations' has "
            f"{columns['observations'].shape}: they must be equal."
        )


def _convert(name: str, values: np.ndarray, source: str) -> np.ndarray:
    """To float32 or bool."""
    if values.dtype.kind not in "biuf":
        raise UserError(f"{source}: {name!r} holds {values.dtype} values: store plain numbers.")
    if name in FLAGS:
        if (odd := np.flatnonzero((values != 0) & (values != 1))).size:
            raise UserError(f"{source}: {name!r} is {values[odd[0]]} at row {odd[0]}: flags must be 0 or 1.")
        return values.astype(bool)
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite and is named below
        numbers = np.ascontiguousarray(values, dtype=np.float32)
    bad = ~np.isfinite(numbers).reshape(len(numbers), -1).all(axis=1)
    if bad.any():
        row = int(bad.argmax())
        raise UserError(
            f"{source}: {name!r} has NaN or infinite values, first at row {row} ({int(bad.sum())} rows in all): "
            "remove those episodes."
        )
    return numbers


def _close_episodes(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A log that stops in mid-episode is truncated there; a lone row after the last ending is no episode and goes."""
    ended = data["terminated"] | data["truncated"]
    if not ended[-1] and len(ended) > 1 and ended[-2]:
        return {name: values[:-1] for name, values in data.items()}
    if not ended[-1]:
        data["truncated"][-1] = True
    return data


def _find_task(asked: str | None, stored: Any, source: str) -> Task | None:
    """The task asked for, else the one named in the file if it is one of ours."""
    name = stored.decode(errors="replace") if isinstance(stored, bytes) else str(stored)
    known = TASKS.get(name)
    if asked is None:
        return known
    task = get_task(asked)
    if known is not None and known.robot != task.robot:
        raise UserError(f"{source} was made for {known.name}, not for {task.name}: set the task to {known.name}.")
    return task


def _check_robot(data: Mapping[str, np.ndarray], task: Task | None, source: str) -> None:
    found = (data["observations"].shape[1], data["actions"].shape[1])
    if task is not None and found != (task.robot.observation_dim, task.robot.action_dim):
        raise UserError(
            f"{source} has {found[0]} observation and {found[1]} action dimensions, and {task.robot.env_id} has "
            f"{task.robot.observation_dim} and {task.robot.action_dim}: choose the task that the data came from."
        )


def _action_limits(
    attributes: Mapping[str, Any], task: Task | None, action_dim: int, source: str
) -> tuple[np.ndarray, np.ndarray]:
    limit = task.robot.action_limit if task else 1.0
    limits = []
    for name, default in (("action_low", -limit), ("action_high", limit)):
        values = np.asarray(attributes.get(name, np.full(action_dim, default)))
        if values.dtype.kind not in "iuf" or values.shape != (action_dim,) or not np.isfinite(values).all():
            raise UserError(f"{source}: {name!r} is {values!s:.80}: it must be {action_dim} finite numbers.")
        limits.append(values.astype(np.float32))
    if not (limits[0] < limits[1]).all():
        raise UserError(f"{source}: 'action_low' {limits[0]} is not below 'action_high' {limits[1]}: mend the limits.")
    return limits[0], limits[1]


def _inside(actions: np.ndarray, low: np.ndarray, high: np.ndarray, source: str) -> np.ndarray:
    outside = ((actions < low - ACTION_TOLERANCE) | (actions > high + ACTION_TOLERANCE)).any(axis=1)
    if outside.any():
        row = int(outside.argmax())
        raise UserError(
            f"{source}: actions reach from {actions.min():g} to {actions.max():g}, outside the action space "
            f"[{low.min():g}, {high.max():g}], first at row {row}: rescale them, or store 'action_low' and "
            "'action_high'."
        )
    return np.clip(actions, low, high)


def _check_lengths(starts: np.ndarray, rows: int, source: str, *, least: int) -> None:
    short = np.flatnonzero(np.diff(starts, append=rows) < least)
    if short.size:
        why = "" if least == 2 else " (three without 'next_observations')"
        raise UserError(
            f"{source}: {short.size} of {len(starts)} episodes have fewer than two steps{why}, first at row "
            f"{starts[short[0]]}: leave such episodes out."
        )


def _shift(data: dict[str, np.ndarray], starts: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Successors from the following row; each episode loses its last row, which has none, and so ends truncated."""
    successors = np.roll(data["observations"], -1, axis=0)
    last = np.append(starts[1:], len(successors)) - 1
    kept = {name: np.delete(values, last, axis=0) for name, values in {**data, "next_observations": successors}.items()}
    starts = starts - np.arange(len(starts))
    kept["truncated"][np.append(starts[1:], len(kept["rewards"])) - 1] = True
    return {name: kept[name] for name in COLUMNS}, starts
