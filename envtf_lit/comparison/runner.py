"""Does what is missing of a grid: rows of results are its state, and each finished run adds one."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from statistics import fmean

from envtf_lit.agents.options import NO_WORLD_MODEL
from envtf_lit.comparison.cell import run_cell, section_of
from envtf_lit.comparison.cluster import run_on_ray
from envtf_lit.comparison.grid import Cell
from envtf_lit.comparison.jobs import Done, Job, Outcome, run_jobs
from envtf_lit.comparison.records import (
    CURVES,
    DATASET,
    SHARED,
    Evaluation,
    Run,
    Shared,
    add_run,
    add_shared,
    read_records,
)
from envtf_lit.comparison.settings import cell_params, policy_options
from envtf_lit.comparison.shared import WORK, Home
from envtf_lit.errors import UserError
from envtf_lit.files import check_writable
from envtf_lit.progress import progress_bar


def run_grid(
    cells: Sequence[Cell],
    results: Path,
    *,
    work: Path = WORK,
    workers: int = 1,
    ray_address: str | None = None,
    progress: bool = True,
    report: Callable[[str], None] = print,
) -> list[Run]:
    """Does the runs that have no row yet, and adds a row as each ends.

    What runs share is made once, before the first that needs it. A run that fails leaves the others to go on.

    Args:
        cells: all of the grid, in the order that they are to be done.
        results: CSV file of the rows; the curves and what the runs share go beside it.
        work: folder of datasets, world models and trained policies.
        workers: processes at a time, each with one thread.
        ray_address: of a Ray cluster that does the runs in their place; see `cluster.run_on_ray`.
        progress: shows a bar.
        report: called with a line for each thing done.

    Returns:
        All rows of these cells.

    Raises:
        UserError: a file is damaged or not one of ours, settings contradict each other, or some runs failed.
    """
    there = {run.key for run in read_all(results)}
    missing = [cell for cell in cells if cell.key not in there]
    report(f"{len(cells) - len(missing)} of {len(cells)} runs are there")
    for cell in missing:
        cell_params(cell, section_of(cell))  # complains before the first is begun
    jobs = list(_jobs(missing, results, work.absolute()))
    clock, failures = _Clock(jobs, workers), list[str]()
    with (
        closing(_execute(jobs, workers, ray_address)) as done,
        progress_bar("Comparing", len(jobs), visible=progress) as update,
    ):
        for job, outcome in done:
            left = clock.done(job, outcome)
            update(advance=1)
            if outcome.error is not None:
                failures.append(f"{job.name}: {outcome.error}")
            report(f"{job.name}: {_enter(results, outcome)} ({outcome.seconds:.0f} s; about {left:.0f} min left)")
    if failures:
        raise UserError(
            f"{len(failures)} of {len(jobs)} jobs failed, the first is {failures[0].rstrip('.')}. What is done is "
            "kept: mend that, and run the same command again."
        )
    wanted = {cell.key for cell in cells}
    return [run for run in read_records(results, Run) if run.key in wanted]


def read_all(results: Path) -> list[Run]:
    """The rows of a comparison whose three files can be read and written.

    Raises:
        UserError: one cannot.
    """
    curves, shared = results.with_name(CURVES), results.with_name(SHARED)
    read_records(curves, Evaluation)
    read_records(shared, Shared)
    runs = read_records(results, Run)
    for path in (results, curves, shared):
        check_writable(path, folder=False)
    return runs


def _jobs(cells: Sequence[Cell], results: Path, work: Path) -> Iterator[Job]:
    """A job for each run; before the first that needs it, one for what is shared and is not there."""
    needed = dict[str, str | None]()  # what is shared, to the job that makes it; None where it is there
    for cell in cells:
        home, before = Home(cell.task, cell.budget, work), list[str]()
        model = policy_options(cell).world_model
        for made in (DATASET, *([] if model == NO_WORLD_MODEL else [model])):
            name = f"{cell.task}, {made}"
            if name not in needed:
                found = home.found(made)
                needed[name] = None if found else name
                if found:
                    add_shared(results, found)
                else:
                    yield Job(name, made, home.make, (made,), home.path / "logs" / f"{made}.log", tuple(before))
            before += [] if needed[name] is None else [name]
        log = home.path / "logs" / f"{section_of(cell)}.log"
        yield Job(str(cell), f"{cell.algorithm} ({cell.kit})", run_cell, (cell, work), log, tuple(before))


def _execute(jobs: Sequence[Job], workers: int, ray_address: str | None) -> Done:
    return run_jobs(jobs, workers) if ray_address is None else run_on_ray(jobs, ray_address, workers)


def _enter(results: Path, outcome: Outcome) -> str:
    """Adds what a job returned to the files; says what it was."""
    if outcome.error is not None:
        return f"failed: {outcome.error}"
    if isinstance(outcome.value, Shared):
        add_shared(results, outcome.value)
        return "made"
    run, curve = outcome.value
    add_run(results, run, curve)
    return f"score {run.score_final:.1f}"


class _Clock:
    """About how long the rest takes: each job as long as those of its kind have, or as all have.

    Args:
        jobs: all of them.
        workers: that do them.
    """

    def __init__(self, jobs: Sequence[Job], workers: int) -> None:
        self.left, self.workers = Counter(job.kind for job in jobs), workers
        self.seconds = defaultdict[str, list[float]](list)

    def done(self, job: Job, outcome: Outcome) -> float:
        """Notes that a job is done; minutes left."""
        self.left[job.kind] -= 1
        if outcome.error is None:
            self.seconds[job.kind].append(outcome.seconds)
        every = [value for values in self.seconds.values() for value in values] or [0.0]
        left = sum(count * fmean(self.seconds.get(kind) or every) for kind, count in self.left.items())
        return left / 60 / self.workers
