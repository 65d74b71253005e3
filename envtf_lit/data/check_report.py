"""The report of `envtf data check`: all facts and all problems of a dataset at once, never a traceback."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from envtf_lit.data.checks import examine
from envtf_lit.data.columns import blocks, column_blocks
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.findings import Finding
from envtf_lit.data.outliers import wild_values
from envtf_lit.data.sources.local import open_source
from envtf_lit.data.sources.raw import ALIASES, Raw
from envtf_lit.data.sources.tables import TABLE_ALIASES
from envtf_lit.data.statistics import CONSTANT
from envtf_lit.errors import UserError
from envtf_lit.robots.tasks import get_task

STYLES = {"error": "bold red", "warning": "yellow", "note": "cyan"}  # the gravest first
BARS = 10  # of the histogram of returns
MIXER = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio: odd, and without pattern
HUGE = 1e8  # a magnitude that float32 arithmetic, which squares, does not go well with
# what others call a column, in the singular: names that tables are read by, and some that nothing is read by
USUAL = {name.removesuffix("s"): ours for ours, names in TABLE_ALIASES.items() for name in names} | {
    "ob": "observations",
    "act": "actions",
    "rew": "rewards",
    "next_ob": "next_observations",
    "done": "terminated",
    "termination": "terminated",
    "truncation": "truncated",
}
SEAM = 1e-3  # of a dimension's standard deviation: more between s' and the next row's s is a gap


@dataclass(frozen=True)
class Column:
    """One column as it lies in the file; `low` and `high` are None where there is no finite number."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    low: float | None
    high: float | None


@dataclass
class Inspection:
    """Everything found in a dataset.

    Attributes:
        source: the file, or what names a Minari dataset.
        columns: those that a dataset has.
        ignored: names of what else is there.
        findings: the gravest first.
        dataset: None where there are errors.
    """

    source: str
    columns: list[Column] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    dataset: OfflineDataset | None = None

    @property
    def usable(self) -> bool:
        """Whether the pipeline can be run on it."""
        return all(finding.kind != "error" for finding in self.findings)


def inspect_source(source: str | Path, *, task: str | None = None) -> Inspection:
    """Looks at all that is in a dataset.

    Args:
        source: an HDF5 (.h5, .hdf5) or NPZ file, `minari:` and the id of a Minari dataset, or such a dataset's folder.
        task: such as `hopper-medium-replay`; None takes the name in the source, where there is one.

    Raises:
        UserError: `task` is none of ours. Whatever is wrong with the source is among the findings.
    """
    result = Inspection(str(source))
    if task is not None:
        get_task(task)
    try:
        with open_source(source) as raw:
            result.columns = [_describe(name, values) for name, values in raw.columns.items()]
            result.ignored = raw.ignored
            result.dataset, result.findings = examine(raw.columns, raw.attributes, task=task, broken=raw.broken)
            result.findings += [*_misnamed(raw), *raw.notes]
    except UserError as error:
        result.findings = [Finding("error", str(error).rstrip("."))]
    if result.dataset is not None:
        result.findings += quality(result.dataset)
    result.findings.sort(key=lambda finding: list(STYLES).index(finding.kind))
    return result


def _misnamed(raw: Raw) -> Iterator[Finding]:
    """What lies there under a name that others use for a column that is missing."""
    there = {*raw.columns, *raw.broken}
    for name in raw.ignored:
        ours = USUAL.get(name.lower().removesuffix("s"))
        if ours is not None and ours not in there:
            yield Finding("note", f"{name!r} is not read", f"if it is what we call {ALIASES[ours][0]!r}, rename it")


def _describe(name: str, values: Any) -> Column:
    low, high = np.inf, -np.inf
    if values.dtype.kind in "biuf" and values.shape:
        try:
            for block in column_blocks(values):
                part = np.asarray(values[block])
                finite = part[np.isfinite(part)]
                if finite.size:
                    low, high = min(low, float(finite.min())), max(high, float(finite.max()))
        except Exception:  # damaged bytes: `examine` says so
            low, high = np.inf, -np.inf
    return Column(name, str(values.dtype), values.shape, *((low, high) if low <= high else (None, None)))


# What is allowed, and probably not meant


def quality(dataset: OfflineDataset) -> list[Finding]:
    """Warnings and notes about a sound dataset."""
    return [
        *_episodes(dataset),
        *_endings(dataset),
        *_seams(dataset),
        *_ranges(dataset),
        *wild_values(dataset),
        *_duplicates(dataset),
    ]


def _episodes(dataset: OfflineDataset) -> Iterator[Finding]:
    count = len(dataset.episode_starts)
    if count == 1:
        yield Finding("error", "there is one episode", "whole episodes are held out for validation: record two or more")
    elif count < 10:
        yield Finding("warning", f"there are {count} episodes", "held-out errors rest on very few: record more")
    single = int((dataset.episode_lengths == 1).sum())
    if single:
        what = f"{single} of {count} episodes are a single step"
        yield Finding("warning", what, "look whether the flags stand at the ends of episodes alone")
    if np.ptp(dataset.rewards) == 0:
        fix = "no policy can be better than another; look whether the right column was stored"
        yield Finding("warning", f"every reward is {dataset.rewards[0]:g}", fix)


def _endings(dataset: OfflineDataset) -> Iterator[Finding]:
    """Terminations that are time limits in truth: a value of zero is then learned where the task goes on."""
    lengths = dataset.episode_lengths
    terminated = dataset.terminated[dataset.episode_ends - 1]
    longest = int(lengths.max())
    at_limit = lengths == longest
    if at_limit.sum() >= 2 and longest > 1 and (at_limit & terminated).sum() > 0.5 * at_limit.sum():
        number = int((at_limit & terminated).sum())
        what = f"{number} terminated episodes all have the greatest length, {longest} steps"
        yield Finding("warning", what, "if that is a time limit, flag their ends as truncated, not terminated")
    elif terminated.all() and len(lengths) > 1:
        fix = "fine if the task ended each time; a time limit or the end of a recording is a truncation"
        yield Finding("note", "every episode is terminated, none truncated", fix)


def _seams(dataset: OfflineDataset) -> Iterator[Finding]:
    """Successors that do not fit the row after: within episodes an end that no flag marks, at ends a shifted column."""
    found = dataset.statistics.observations
    scale = SEAM * torch.maximum(found.std, CONSTANT * found.largest).numpy()
    last = np.zeros(len(dataset), bool)
    last[dataset.episode_ends - 1] = True
    gaps, first, borrowed = 0, -1, 0
    for block in blocks(len(dataset) - 1, 4 * dataset.observation_dim):
        after = slice(block.start + 1, block.stop + 1)
        with np.errstate(over="ignore"):  # infinitely far is far
            jump = (np.abs(dataset.next_observations[block] - dataset.observations[after]) > scale).any(axis=1)
        borrowed += int((~jump & last[block]).sum())
        jump &= ~last[block]
        first = block.start + int(jump.argmax()) if first < 0 and jump.any() else first
        gaps += int(jump.sum())
    if gaps:
        what = f"{gaps} rows inside episodes have a successor that is not the next row's state, first at row {first}"
        yield Finding("warning", what, "mark the ends of episodes there (truncated), or mend 'next_observations'")
    if borrowed:
        what = f"{borrowed} of {last.sum() - 1} ends of episodes have the next episode's first state as their successor"
        fix = "unless a recording was merely cut there, 'next_observations' is 'observations' shifted: store what came"
        yield Finding("warning", what, fix)


def _ranges(dataset: OfflineDataset) -> Iterator[Finding]:
    """Dimensions that say nothing, and values that no quantity has."""
    for name in ("observations", "actions", "rewards"):
        found = getattr(dataset.statistics, name)
        dead = (~found.live).nonzero()[:, 0].numpy()
        if dead.size and name != "rewards":
            what = f"{dead.size} of {len(found.live)} dimensions of {name!r} are constant in float32 ({_listed(dead)})"
            yield Finding("note" if name == "observations" else "warning", what, "leave them out, if they say nothing")
        most = found.largest
        if most.max() > HUGE:
            where = f" in dimension {most.argmax()}" if name != "rewards" else ""
            fix = "look for a stand-in for missing values, or change the unit"
            yield Finding("warning", f"{name!r} reach a magnitude of {most.max():.2g}{where}", fix)


def _duplicates(dataset: OfflineDataset) -> Iterator[Finding]:
    codes = np.concatenate(
        [
            _codes(np.concatenate([dataset.observations[block], dataset.actions[block]], axis=1))
            for block in column_blocks(dataset.observations)
        ]
    )
    again = len(codes) - len(np.unique(codes))
    if again:
        what = f"{again} of {len(codes)} rows repeat the observation and action of another"
        yield Finding(
            "warning", what, "look whether episodes were stored twice: they count twice, and leak into held-out ones"
        )


def _codes(rows: np.ndarray) -> np.ndarray:
    """(n,) uint64 hash of the bits of float32 rows (n, D)."""
    bits = np.ascontiguousarray(rows).view(np.uint32).astype(np.uint64)
    code = np.zeros(len(rows), np.uint64)
    for column in bits.T:
        code = (code ^ column) * MIXER
        code ^= code >> np.uint64(29)
    return code


def _listed(numbers: np.ndarray) -> str:
    shown = ", ".join(map(str, numbers[:8]))
    return shown + (", …" if len(numbers) > 8 else "")


# For people to read


def render(inspection: Inspection) -> RenderableType:
    """The report, for a rich console."""
    parts: list[RenderableType] = [Text(inspection.source, "bold"), _columns_table(inspection)]
    if inspection.ignored:
        parts.append(Text(f"also there, not read: {', '.join(map(str, inspection.ignored[:8]))}"[:400]))
    if inspection.dataset is not None:
        parts += [_facts(inspection.dataset), _histogram(inspection.dataset.episode_returns)]
    for finding in inspection.findings:
        line = Text(f"{finding.kind}: ", STYLES[finding.kind])
        parts.append(
            line.append(finding.what, "default").append(f"\n    → {finding.fix}" if finding.fix else "", "dim")
        )
    counts = {kind: sum(f.kind == kind for f in inspection.findings) for kind in STYLES}
    verdict = "usable" if inspection.usable else "not usable"
    tail = ", ".join(f"{number} {kind}{'s' * (number != 1)}" for kind, number in counts.items() if number)
    parts.append(Text(f"{verdict}{': ' if tail else ''}{tail}", "bold green" if inspection.usable else "bold red"))
    return Group(*parts)


def _columns_table(inspection: Inspection) -> Table:
    table = Table("column", "type", "shape", "least", "greatest", box=None, pad_edge=False)
    for column in inspection.columns:
        ends = ("" if value is None else f"{value:.6g}" for value in (column.low, column.high))
        table.add_row(column.name, column.dtype, str(column.shape), *ends)
    return table


def _facts(dataset: OfflineDataset) -> Text:
    lengths, returns = dataset.episode_lengths, dataset.episode_returns
    terminated = int(dataset.terminated.sum())
    return Text(
        f"{len(dataset):,} transitions in {len(lengths):,} episodes of {lengths.min()} to {lengths.max()} steps "
        f"(mean {lengths.mean():.1f}): {terminated:,} terminated, {len(lengths) - terminated:,} truncated\n"
        f"task {dataset.task or 'not named'}; action space within "
        f"[{dataset.action_low.min():g}, {dataset.action_high.max():g}]\n"
        f"returns {returns.min():.6g} to {returns.max():.6g}, mean {returns.mean():.6g}, std {returns.std():.6g}"
    )


def _histogram(returns: np.ndarray) -> Table:
    table = Table("return", "episodes", "", box=None, pad_edge=False)
    counts, edges = np.histogram(returns.astype(np.float64), bins=BARS if np.ptp(returns) > 0 else 1)
    for number, low, high in zip(counts, edges, edges[1:], strict=False):
        table.add_row(f"{low:.4g} to {high:.4g}", str(number), "█" * round(40 * number / counts.max()))
    return table
