"""The files of a comparison: one row per finished run, its curve, and what the runs of a task share.

`results.csv` says which runs are done. Whoever adds to the files holds a lock, reads them again, and replaces them
whole, so that nothing is lost to a kill or to another command that works on the same grid.
"""

import csv
import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from filelock import FileLock

from envtf_lit.comparison.budgets import read_budget
from envtf_lit.comparison.grid import KITS, WEIGHTED_BC, Key, known
from envtf_lit.errors import UserError
from envtf_lit.files import check_plain, replacing
from envtf_lit.robots.tasks import ROBOTS, TIERS

RESULTS = Path("benchmarks/comparison/results.csv")
CURVES, SHARED = "curves.csv", "shared.csv"  # beside the results
MOST = 64 << 20  # bytes of such a file; the whole grid's have a megabyte
DATASET = "dataset"  # what a row of SHARED is about, if not a world model


@dataclass(frozen=True)
class Named:
    """What names a run; see `grid.Cell`."""

    robot: str
    tier: str
    algorithm: str
    kit: str
    seed: int
    budget: str

    @property
    def run(self) -> Key:
        """The same as no other run."""
        return (self.robot, self.tier, self.algorithm, self.kit, self.seed, self.budget)


@dataclass(frozen=True)
class Run(Named):
    """A finished run, a row of `results.csv`.

    Attributes:
        updates: gradient steps that the scored policy was trained for: fewer than the budget's where training diverged
            and the last sound policy was scored.
        score_final: mean D4RL-normalised score of the policy at the end, over `episodes`.
        score_last10: mean of the last ten evaluations along the way, fewer where there were fewer.
        score_best: the highest of all evaluations: what one gets who chooses the checkpoint in the simulator.
        score_weighted_bc: `score_final` of the weighted BC of the same task, kit, seed and budget, once it is done.
        episodes: of the evaluation at the end.
        seconds: of training, evaluations and world model left out.
        memory_mb: most that the run's process held, MB.
        device: that it was trained on.
        commit: of the code, or its version.
    """

    updates: int
    score_final: float
    score_last10: float
    score_best: float
    score_weighted_bc: float | None
    episodes: int
    seconds: float
    memory_mb: float
    device: str
    commit: str

    @property
    def key(self) -> Key:
        """What no two rows have in common."""
        return self.run


@dataclass(frozen=True)
class Evaluation(Named):
    """An evaluation along the way of a run, a row of `curves.csv`: mean score after so many updates."""

    updates: int
    score: float

    @property
    def key(self) -> tuple[Key, int]:
        """What no two rows have in common."""
        return self.run, self.updates


@dataclass(frozen=True)
class Shared:
    """What the runs of a task share, a row of `shared.csv`: its dataset, or a world model.

    Attributes:
        robot, tier, budget: of the runs.
        made: `dataset`, or the world model's name.
        seconds: of making it; of a world model with the clone and the first rollouts.
        memory_mb: most that the process held meanwhile, MB.
        transitions, episodes: of a dataset.
        score_mean, score_best: of a dataset's episodes, those left out that are cut short; normalised.
    """

    robot: str
    tier: str
    budget: str
    made: str
    seconds: float
    memory_mb: float
    transitions: int | None = None
    episodes: int | None = None
    score_mean: float | None = None
    score_best: float | None = None

    @property
    def key(self) -> tuple[str, ...]:
        """What no two rows have in common."""
        return (self.robot, self.tier, self.budget, self.made)


Record = TypeVar("Record", Run, Evaluation, Shared)


def read_records(path: Path, cls: type[Record]) -> list[Record]:
    """The rows of a file; none where there is no file.

    Raises:
        UserError: it is not such a file, or damaged.
    """
    try:
        check_plain(path, MOST)
        with path.open(newline="", encoding="utf-8") as stream:
            return list(_records(path, csv.reader(stream, strict=True), cls))
    except FileNotFoundError:
        return []
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path} is no CSV file ({error}). {CURE}") from None


CURE = "Put the file back as it was, or move it away."


def _records(path: Path, lines: Iterator[list[str]], cls: type[Record]) -> Iterator[Record]:
    names = [field.name for field in fields(cls)]
    if (head := next(lines, [])) != names:
        found = f"the columns {', '.join(head)}" if head else "no columns"
        raise UserError(f"{path} has {found}, where {', '.join(names)} belong: it is another file. {CURE}")
    hints, seen = get_type_hints(cls), set[object]()
    for number, line in enumerate(lines, start=2):
        try:
            if len(line) != len(names):
                raise UserError(f"{len(line)} values, and there are {len(names)} columns.")
            record = cls(**{name: _value(name, hints[name], text) for name, text in zip(names, line, strict=True)})
            if record.key in seen:
                raise UserError("the same as in an earlier line.")
        except UserError as error:
            raise UserError(f"{path} is damaged in line {number}: {error} {CURE}") from None
        seen.add(record.key)
        yield record


_NAMES = {"robot": ROBOTS, "tier": TIERS, "kit": KITS}


def _value(name: str, hint: Any, text: str) -> Any:
    """A cell's value; the names of algorithms that are no more are kept.

    Raises:
        UserError: it is of another type, or a name that is unknown.
    """
    if hint is str:
        if not text:
            raise UserError(f"{name} is empty.")
        if name == "budget":
            read_budget(text)
        return known(name, text, _NAMES[name]) if name in _NAMES else text
    if not text and hint in (float | None, int | None):
        return None
    kind = int if hint in (int, int | None) else float
    try:
        value = kind(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UserError(f"{name} is {text!r}, expected a {'whole ' if kind is int else ''}number.")
    return value


def add_run(results: Path, run: Run, curve: Sequence[Evaluation]) -> None:
    """Adds a finished run: its curve first, so that every run that is there has one.

    A run that is there already stays. Rows that can now be compared with their weighted BC are completed.

    Raises:
        UserError: a file is damaged, or cannot be written.
    """
    curves = results.with_name(CURVES)
    with alone(results):
        runs = read_records(results, Run)
        if any(other.key == run.key for other in runs):
            return
        others = [point for point in read_records(curves, Evaluation) if point.run != run.key]
        _write(curves, Evaluation, [*others, *curve])
        _write(results, Run, with_weighted_bc([*runs, run]))


def add_shared(results: Path, shared: Shared) -> None:
    """Notes what the runs of a task share, in place of what was noted of it before.

    Raises:
        UserError: the file is damaged, or cannot be written.
    """
    path = results.with_name(SHARED)
    with alone(results):
        others = [other for other in read_records(path, Shared) if other.key != shared.key]
        _write(path, Shared, [*others, shared])


def with_weighted_bc(runs: Iterable[Run]) -> list[Run]:
    """The same rows, each with the score of the weighted BC of its task, kit, seed and budget, if that is there."""
    runs = list(runs)
    scores = {_without_algorithm(run): run.score_final for run in runs if run.algorithm == WEIGHTED_BC}
    return [replace(run, score_weighted_bc=scores.get(_without_algorithm(run))) for run in runs]


def _without_algorithm(run: Run) -> tuple[str, str, str, int, str]:
    return (run.robot, run.tier, run.kit, run.seed, run.budget)


@contextmanager
def alone(path: Path) -> Iterator[None]:
    """While it lasts, no other process is in here with the same path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_name(f".{path.name}.lock")):
        yield


def _write(path: Path, cls: type[Record], records: Sequence[Record]) -> None:
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([field.name for field in fields(cls)])
        writer.writerows([["" if value is None else value for value in astuple(record)] for record in records])
