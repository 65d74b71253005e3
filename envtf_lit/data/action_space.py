"""The action space of a dataset: its limits, and whether the recorded actions agree with them."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from envtf_lit.data.columns import Column, column_blocks
from envtf_lit.data.findings import Finding
from envtf_lit.robots.tasks import Task

# where a file may state them: an attribute or an array, of the file or of a group; the first is where we write them
PLACES = {
    f"action_{end}": (
        f"action_{end}",
        f"action_space/{end}",
        f"action_space_{end}",
        f"metadata/action_{end}",
        f"metadata/action_space/{end}",
    )
    for end in ("low", "high")
}
TOLERANCE = 1e-5  # of half the action space, which is what rounding may add
FILLED = 0.9  # of the way from 0 to a limit: actions that reach less far speak against that limit
FEW = 32  # different whole numbers, of which a discrete action space may consist
OTHER_METHOD = "if they number choices, take another method: here actions are continuous"
STATE = (
    "state the robot's own: 'action_low' and 'action_high' in the file, as attributes or arrays, or "
    "`envtf data convert IN OUT --action-low LOW --action-high HIGH`"
)


def gather_limits(stated: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """`action_low` and `action_high`, from what a file states at the `PLACES`; words where two of them disagree."""
    limits = {}
    for name, places in PLACES.items():
        found = {place: np.asarray(stated[place]) for place in places if stated.get(place) is not None}
        if not found:
            continue
        first, *others = found
        odd = next((place for place in others if not np.array_equal(found[place], found[first])), None)
        words = odd and np.array(f"{found[first]} at {first!r} and {found[odd]} at {odd!r}")
        limits[name] = found[first] if words is None else words
    return limits


def read_limits(
    attributes: Mapping[str, Any], task: Task | None, actions: Column, findings: list[Finding]
) -> tuple[np.ndarray, np.ndarray]:
    """(A,) float32 each: those stated, else the task's; where nobody states any, [-1, 1] if the actions fill that.

    Args:
        attributes: may hold `action_low` and `action_high`, each one number or A.
        task: whose robot has limits; None is a robot of one's own.
        actions: (N, A) float32.
        findings: what is wrong with the limits is added.
    """
    dimensions = actions.shape[1]
    limit = task.robot.action_limit if task else 1.0
    stated = [name for name in PLACES if attributes.get(name) is not None]
    limits = []
    for name, default in (("action_low", -limit), ("action_high", limit)):
        values = np.asarray(attributes[name] if name in stated else default)
        if values.dtype.kind not in "iuf" or values.shape not in ((), (1,), (dimensions,)) or not _finite(values):
            findings.append(Finding("error", f"{name!r} is {values!s:.80}", f"it must be {dimensions} finite numbers"))
            values = np.asarray(default)
        with np.errstate(over="ignore"):
            limits.append(np.broadcast_to(values, dimensions).astype(np.float32))
    low, high = limits
    if not (np.isfinite(limits).all() and (low < high).all()):
        findings.append(Finding("error", f"'action_low' {low} is not below 'action_high' {high}", "mend the limits"))
    if len(stated) == 1 and task is None:
        other = next(name for name in PLACES if name not in stated)
        findings.append(Finding("error", f"there is {stated[0]!r} and no {other!r}", "store both, or neither"))
    elif not stated and task is None:
        findings += _unstated(actions)
    return low, high


def _finite(values: np.ndarray) -> bool:
    return bool(np.isfinite(values).all())


def _unstated(actions: Column) -> list[Finding]:
    """An error where [-1, 1] would be a guess that the actions speak against."""
    low, high = np.full(actions.shape[1], np.inf), np.full(actions.shape[1], -np.inf)
    for block in column_blocks(actions):
        low, high = np.minimum(low, actions[block].min(axis=0)), np.maximum(high, actions[block].max(axis=0))
    odd = np.flatnonzero(~((low <= -FILLED) & (high >= FILLED)))
    if not odd.size or not _finite(np.stack([low, high])):
        return []
    worst = int(odd[0])
    what = f"no action limits are stated, and actions reach from {low[worst]:.3g} to {high[worst]:.3g} in dimension"
    return [Finding("error", f"{what} {worst}, which does not fill the usual [-1, 1]", STATE)]


def inside(actions: Column, low: np.ndarray, high: np.ndarray, findings: list[Finding]) -> Column:
    """Actions (N, A) in their space: what lies a rounding error outside is moved to its edge."""
    first, count, least, most, over = -1, 0, np.inf, -np.inf, False
    with np.errstate(over="ignore"):
        tolerance = TOLERANCE * (high - low) / 2
    for block in column_blocks(actions):
        part = actions[block]
        outside = ((part < low - tolerance) | (part > high + tolerance)).any(axis=1)
        if outside.any() and first < 0:
            first = block.start + int(outside.argmax())
        count += int(outside.sum())
        least, most = min(least, part.min()), max(most, part.max())
        over = over or bool(((part < low) | (part > high)).any())
    if first >= 0:
        space = f"outside the action space [{low.min():g}, {high.max():g}]"
        share = f"in {count / len(actions):.1%} of the rows, first at row {first}"
        fix = (
            "clip them (np.clip), if the environment did so before it acted; rescale them, if their unit is another; "
            "or store the robot's true 'action_low' and 'action_high'"
        )
        findings.append(Finding("error", f"actions reach from {least:g} to {most:g}, {space} {share}", fix))
    return np.clip(np.asarray(actions), low, high) if over else actions


def discrete(actions: Column) -> list[Finding]:
    """A warning where all actions (N, A) are whole numbers, and few: choices, not quantities."""
    seen: set[float] = set()
    for block in column_blocks(actions):
        part = actions[block]
        if not (part == np.round(part)).all():
            return []
        seen.update(np.unique(part).tolist())
        if len(seen) > FEW:
            return []
    if len(seen) < 2:
        return []
    what = f"all actions are whole numbers ({', '.join(f'{value:g}' for value in sorted(seen)[:8])})"
    return [Finding("warning", what, OTHER_METHOD)]
