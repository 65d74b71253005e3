"""Checks of columns as read from a file, and the `OfflineDataset` made of those that pass."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Set
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

from envtf_lit.data.action_space import OTHER_METHOD, discrete, inside, read_limits
from envtf_lit.data.columns import Column, FileRows, column_blocks, take
from envtf_lit.data.dataset import COLUMNS, OfflineDataset, starts_from_ends
from envtf_lit.data.findings import Finding
from envtf_lit.data.statistics import Moments
from envtf_lit.errors import UserError
from envtf_lit.robots.tasks import Task, find_task, get_task

CONTRADICTIONS = 0.2  # share of falls that log and rule may see differently: some logs are rounded, or end early
FEWEST_FALLS = 20  # that they must see differently
RANKS = {
    "observations": 2,
    "actions": 2,
    "rewards": 1,
    "next_observations": 2,
    "terminated": 1,
    "truncated": 1,
    "episode_index": 1,
}
NUMBERS = ("observations", "actions", "rewards", "next_observations")
FLAGS = {"terminated": "terminals", "truncated": "timeouts"}  # and what D4RL calls them
NEEDED = ("observations", "actions", "rewards")
LARGEST = 1e19  # a magnitude whose square is a float32
ROUNDING = 1e-12  # of a magnitude: what varies less in float64 is rounding itself


def build_dataset(
    columns: Mapping[str, Any],
    attributes: Mapping[str, Any],
    *,
    task: str | None,
    source: str,
    broken: Mapping[str, Finding] = MappingProxyType({}),
) -> OfflineDataset:
    """Checks columns as read from a file and makes the dataset.

    Args:
        columns: see `examine`.
        attributes: see `examine`.
        task: see `examine`.
        source: what to call the data in messages.
        broken: see `examine`.

    Raises:
        UserError: the first error that `examine` finds.
    """
    dataset, findings = examine(columns, attributes, task=task, broken=broken)
    if dataset is None:
        raise UserError(f"{source}: {next(finding for finding in findings if finding.kind == 'error')}.")
    return dataset


def examine(
    columns: Mapping[str, Any],
    attributes: Mapping[str, Any],
    *,
    task: str | None = None,
    broken: Mapping[str, Finding] = MappingProxyType({}),
) -> tuple[OfflineDataset | None, list[Finding]]:
    """Checks columns as read from a file, all of them, and makes the dataset if there is no error.

    Args:
        columns: arrays, or what has `shape`, `dtype` and slices like one, by the names in `RANKS`.
        attributes: `task`, `action_low`, `action_high`, `held_out` (E,), each optional.
        task: overrides the name in `attributes`.
        broken: columns that could not be read, by name, and why.

    Returns:
        The dataset, None if anything in the columns is an error; and everything found.

    Raises:
        UserError: `task` is none of ours.
    """
    findings = [*broken.values(), *_missing({*columns, *broken}), *_misshapen(columns)]
    data: dict[str, Any] = {}
    for name, values in columns.items():
        if len(values.shape) == RANKS[name] and 0 not in values.shape:
            data[name] = _read(name, values, findings)
    known = _find_task(task, attributes.get("task"), findings)
    if not _check_robot(data, known, findings):
        known = None  # whose action limits mean nothing then
    low, high = np.zeros((2, 0), np.float32)
    if "actions" in data:
        low, high = read_limits(attributes, known, data["actions"], findings)
        data["actions"] = inside(data["actions"], low, high, findings)
        findings += discrete(data["actions"])
    starts, held_out = np.zeros(0, np.int64), None
    if not _failed(findings):
        starts = _find_episodes(data, findings)
        held_out = _held_out(attributes.get("held_out"), len(starts), findings)
    if not _failed(findings) and "next_observations" not in data:
        longer = np.diff(starts, append=len(data["rewards"])) > 1  # the others have no row left
        held_out = None if held_out is None else held_out[longer]
        data, starts = _shift(data, starts, findings)
    if not _failed(findings) and known is not None:
        findings += _contradicts_rule(data, known)
    if _failed(findings):
        return None, findings
    dataset = OfflineDataset(
        **{name: data[name] for name in COLUMNS},
        episode_starts=starts,
        action_low=low,
        action_high=high,
        task=known.name if known else None,
        held_out=held_out,
    )
    return dataset, findings


def _failed(findings: list[Finding]) -> bool:
    return any(finding.kind == "error" for finding in findings)


def _missing(columns: Set[str]) -> Iterator[Finding]:
    for name in NEEDED:
        if name not in columns:
            yield Finding("error", f"there are no {name!r}", f"a dataset needs {', '.join(NEEDED)} and episode ends")
    for name, other in FLAGS.items():
        if name not in columns and "episode_index" not in columns:
            fix = "store both flags, all False where it never happens, or an 'episode_index'"
            yield Finding("error", f"there is no {name!r} (or {other!r})", fix)


def _misshapen(columns: Mapping[str, Any]) -> Iterator[Finding]:
    """At most one finding for each column, though what is wrong with one shape contradicts several others."""
    sound: dict[str, tuple[int, ...]] = {}
    for name, values in columns.items():
        if len(values.shape) != RANKS[name]:
            want = "(N, dimensions)" if RANKS[name] == 2 else "(N,)"
            choices = name == "actions" and len(values.shape) == 1 and values.dtype.kind in "iu"
            fix = f"{OTHER_METHOD}; else reshape them to {want}" if choices else f"reshape it to {want}"
            yield Finding("error", f"{name!r} has shape {values.shape}", fix)
        elif 0 in values.shape:
            yield Finding("error", f"{name!r} has shape {values.shape}, which is empty", "collect some transitions")
        else:
            sound[name] = values.shape
    lengths = Counter(shape[0] for shape in sound.values())
    rows = max(lengths, key=lambda length: lengths[length], default=0)  # those of most columns
    equal = {name: shape for name, shape in sound.items() if shape[0] == rows}
    for name, shape in sound.items():
        if shape[0] != rows:
            what = f"{name!r} has {shape[0]} rows and {next(iter(equal))!r} has {rows}"
            yield Finding("error", what, "write all columns equally long")
    here, there = equal.get("observations"), equal.get("next_observations")
    if here is not None and there is not None and here != there:
        yield Finding("error", f"'next_observations' has shape {there} and 'observations' {here}", "make them equal")


def _read(name: str, values: Any, findings: list[Finding]) -> Column:
    """As float32, bool or int64, block by block; what is wrong with the values goes to the findings."""
    dtype = np.float32 if name in NUMBERS else bool if name in FLAGS else np.int64
    if values.dtype.kind not in "biuf":
        findings.append(Finding("error", f"{name!r} holds {values.dtype} values", "store plain numbers"))
        return np.zeros(values.shape, dtype)
    if dtype is np.float32 and values.dtype.itemsize > 4:
        findings.append(Finding("note", f"{name!r} is {values.dtype} and becomes float32"))
    plain = isinstance(values, np.ndarray) and values.dtype == dtype and values.flags.c_contiguous
    keep = plain or isinstance(values, FileRows)
    column: Any = values if keep else np.empty(values.shape, dtype)
    bad, first = 0, -1
    for block in column_blocks(column):
        try:
            part = np.asarray(values[block])
        except Exception as error:  # whatever a decoder of damaged bytes raises
            findings.append(Finding("error", f"{name!r} cannot be read ({_one_line(error)})", "write the file anew"))
            break
        wrong = ~_sound(part, dtype)
        if wrong.any():
            first = first if bad else block.start + int(wrong.argmax())
            bad += int(wrong.sum())
        if not keep:
            with np.errstate(over="ignore", invalid="ignore"):
                column[block] = part
    if bad:
        findings.append(_unsound(name, bad, first, np.asarray(values[first : first + 1])))
    elif dtype is np.float32 and values.dtype.itemsize > 4 and not _failed(findings):
        findings += _lost_detail(name, values)
    return column


def _lost_detail(name: str, values: Any) -> Iterator[Finding]:
    """Dimensions that vary, but so little beside their magnitude that float32 makes them constant."""
    width = math.prod(values.shape[1:])
    parts = (np.asarray(values[block], np.float64).reshape(-1, width) for block in column_blocks(values))
    found = Moments.of(map(torch.as_tensor, parts))
    lost = ~found.live & (found.std > ROUNDING * found.largest)
    for index in lost.nonzero()[:, 0].tolist():
        where = f" in dimension {index}" if len(values.shape) == 2 else ""
        size = f"by {found.std[index]:.2g} (standard deviation) around {found.mean[index]:.4g}"
        fix = "subtract an offset, such as a first value, before you store it"
        yield Finding("warning", f"{name!r} varies{where} {size}, of which float32 keeps next to nothing", fix)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _sound(part: np.ndarray, dtype: type) -> np.ndarray:
    """(n,) whether each row can be stored as that type: of squares finite in float32, 0 or 1, a whole number."""
    if dtype is bool:
        return np.isin(part, (0, 1))
    if dtype is np.int64:
        exact = part.astype(np.float64)
        return np.less(np.abs(exact), 2**53) & np.equal(exact, np.round(exact))
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite; NaN is no less than anything
        return np.atleast_1d(
            (np.abs(part.astype(np.float32, copy=False)) <= LARGEST).reshape(len(part), -1).all(axis=1)
        )


def _unsound(name: str, bad: int, first: int, value: np.ndarray) -> Finding:
    if name in FLAGS:
        return Finding("error", f"{name!r} is {value[0]} at row {first} ({bad} rows in all)", "flags must be 0 or 1")
    if name == "episode_index":
        return Finding("error", f"{name!r} is {value[0]} at row {first}", "number the episodes with whole numbers")
    if np.isfinite(value).all():
        what = f"{name!r} reaches {value.flat[np.abs(value).argmax()]:.3g} at row {first} ({bad} rows in all)"
        return Finding(
            "error", f"{what}, whose square float32 cannot hold", "remove those episodes, or change the unit"
        )
    what = f"{name!r} has NaN or infinite values, first at row {first} ({bad} rows in all)"
    return Finding("error", what, "remove those episodes")


def _find_task(asked: str | None, stored: Any, findings: list[Finding]) -> Task | None:
    """The task asked for, else the one named in the file if it is one of ours."""
    name = stored.decode(errors="replace") if isinstance(stored, bytes) else str(stored)
    known = find_task(name)
    if asked is None:
        return known
    task = get_task(asked)
    if known is not None and known.robot != task.robot:
        what = f"the data was made for {known.name}, not for {task.name}"
        findings.append(Finding("error", what, f"set the task to {known.name}"))
    return task


def _check_robot(data: Mapping[str, Column], task: Task | None, findings: list[Finding]) -> bool:
    """Whether the dimensions are the robot's."""
    if task is None or "observations" not in data or "actions" not in data:
        return True
    found = (data["observations"].shape[1], data["actions"].shape[1])
    wanted = (task.robot.observation_dim, task.robot.action_dim)
    if found != wanted:
        what = f"there are {found[0]} observation and {found[1]} action dimensions, and {task.robot.env_id} has"
        fix = "choose the task that the data came from, or null for a robot of your own"
        findings.append(Finding("error", f"{what} {wanted[0]} and {wanted[1]}", fix))
    return found == wanted


def _contradicts_rule(data: Mapping[str, Column], task: Task) -> Iterator[Finding]:
    """Whether the log's terminations are those of another robot: walker2d and halfcheetah have the same dimensions."""
    columns = data["next_observations"], data["terminated"]
    fallen = [task.robot.terminated(torch.as_tensor(columns[0][block])).numpy() for block in column_blocks(columns[0])]
    rule, logged = np.concatenate(fallen), np.asarray(columns[1], bool)
    wrong, either = int((rule != logged).sum()), int((rule | logged).sum())
    if wrong > max(CONTRADICTIONS * either, FEWEST_FALLS):
        what = f"{wrong} of {either} falls, by the log or by {task.robot.name}'s rule, are falls by one of them alone"
        yield Finding("warning", what, "choose the task that the data came from, or null for a robot of your own")


def _held_out(stored: Any, episodes: int, findings: list[Finding]) -> np.ndarray | None:
    """(E,) bool, which episodes the file says are held out; None where it does not say."""
    if stored is None:
        return None
    values = np.asarray(stored)
    plain = values.dtype.kind in "biuf" and values.shape == (episodes,) and np.isin(values, (0, 1)).all()
    if not plain or len(np.unique(values)) < 2:
        what = f"'held_out' has shape {values.shape}, and there are {episodes} episodes"
        fix = "store for each episode 1 if it is held out and 0 if not, some of both; or leave it out"
        findings.append(Finding("error", what, fix))
        return None
    return values.astype(bool)


def _find_episodes(data: dict[str, Any], findings: list[Finding]) -> np.ndarray:
    """(E,) starts, and the flags made to mark the last row of every episode.

    An episode ends where a flag is set or the index changes. An end without a flag is a truncation.
    """
    rows = len(data["rewards"])
    flags = {name: data.get(name, np.zeros(rows, bool)).copy() for name in FLAGS}
    ends = flags["terminated"] | flags["truncated"]
    if "episode_index" in data:
        ends = _indexed_ends(data["episode_index"], ends, findings)
    elif not ends[-1]:
        findings.append(Finding("note", "the log stops inside an episode, whose last row counts as truncated"))
    ends[-1] = True
    flags["truncated"] |= ends & ~flags["terminated"]
    data |= flags
    both = int((data["terminated"] & data["truncated"]).sum())
    if both:
        what = f"{both} rows are both terminated and truncated"
        findings.append(Finding("note", f"{what}; they count as terminated: no future reward"))
    return starts_from_ends(ends)


def _indexed_ends(index: np.ndarray, flagged: np.ndarray, findings: list[Finding]) -> np.ndarray:
    """(N,) the last rows of the index's episodes, which every flag must agree with."""
    ends = np.append(index[1:] != index[:-1], True)
    names, first = np.unique(index[starts_from_ends(ends)], return_index=True)
    if len(names) < ends.sum():
        again = np.setdiff1d(np.arange(int(ends.sum())), first)[0]
        row = starts_from_ends(ends)[again]
        what = f"'episode_index' comes back to {index[row]} at row {row}, after other episodes"
        findings.append(Finding("error", what, "write each episode's rows one after the other"))
    inside = np.flatnonzero(flagged & ~ends)
    if inside.size:
        what = f"an episode ends at row {inside[0]} by its flags and goes on by 'episode_index' ({inside.size} rows)"
        findings.append(Finding("error", what, "make them agree, or leave one out"))
    return ends


def _shift(data: dict[str, Any], starts: np.ndarray, findings: list[Finding]) -> tuple[dict[str, Any], np.ndarray]:
    """Successors from the following row; each episode loses its last row, which has none, and so ends truncated."""
    rows = len(data["rewards"])
    last = np.zeros(rows, bool)
    last[np.append(starts[1:], rows) - 1] = True
    kept = np.flatnonzero(~last)
    if not kept.size:
        what = "there is no 'next_observations', and every episode is a single row"
        findings.append(Finding("error", what, "store 'next_observations'"))
        return data, starts
    lost = int((data["terminated"] & last).sum())
    what = f"there is no 'next_observations': the last row of each of {last.sum()} episodes is left out"
    findings.append(
        Finding("note", f"{what}, and with it {lost} terminations", "store 'next_observations' to keep them")
    )
    episode = np.repeat(np.arange(len(starts)), np.diff(starts, append=rows))[kept]
    ends = np.append(episode[1:] != episode[:-1], True)
    shifted: dict[str, Any] = {name: take(data[name], kept) for name in ("observations", "actions", "rewards")}
    shifted["next_observations"] = take(data["observations"], kept + 1)
    shifted["terminated"], shifted["truncated"] = np.zeros(len(kept), bool), ends
    return shifted, starts_from_ends(ends)
