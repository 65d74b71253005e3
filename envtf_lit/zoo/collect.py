"""Collection of datasets by behaviour policies in MuJoCo, the same rows with any number of processes."""

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import accumulate
from pathlib import Path

import numpy as np
import torch

from envtf_lit.data.dataset import OfflineDataset, starts_from_ends
from envtf_lit.errors import UserError
from envtf_lit.policy import Policy, RandomPolicy
from envtf_lit.progress import progress_bar
from envtf_lit.robots.tasks import Robot, Task
from envtf_lit.workers import end_with_parent
from envtf_lit.zoo.record import Columns, empty_columns, record
from envtf_lit.zoo.snapshots import MIN_ROWS, Phase, Series, load_snapshot, plan, read_series

ENVIRONMENTS = 8  # per unit of work; a constant, since the policy's rounding may depend on the batch size
UNIT_ROWS = 24_000  # at most, per unit of work: three episodes of 1,000 steps in each environment, so none is wasted


def collect(
    task: Task, transitions: int, *, seed: int, workers: int, zoo: Path | None = None, progress: bool = True
) -> OfflineDataset:
    """Lets the task's behaviour policies act in MuJoCo, with stochastic actions.

    The bytes depend on `seed` and `transitions`, not on `workers`: each phase of the plan is cut into units of work
    with their own seeds, which are merged in order. Only the last episode of each unit is cut, and marked truncated.

    Args:
        task: robot and tier; the variants of Ant with more observations are driven by their first 27.
        transitions: rows of the dataset, exactly.
        seed: of the environments and the actions.
        workers: processes; above 1 a calling script needs its `if __name__ == "__main__":`.
        zoo: a folder that `envtf zoo train` wrote; None takes the package's snapshots.
        progress: shows a bar with the time left.

    Raises:
        UserError: `transitions` is too small, a snapshot cannot be read, or a worker process died.
    """
    series = read_series(task.robot, zoo)
    units = [unit for phase in plan(task, transitions, series) for unit in _units(phase)]
    starts = [0, *accumulate(unit.rows for unit in units)]
    columns = empty_columns(task.robot, (transitions,))
    with progress_bar(f"Collecting {task.name}", transitions, visible=progress) as update:
        for index, collected in _run(task.robot, series, units, seed, workers):
            for name, rows in collected.items():
                columns[name][starts[index] : starts[index + 1]] = rows
            update(advance=units[index].rows)
    limit = np.full(task.robot.action_dim, task.robot.action_limit, dtype=np.float32)
    return OfflineDataset(
        **columns,
        episode_starts=starts_from_ends(columns["terminated"] | columns["truncated"]),
        action_low=-limit,
        action_high=limit,
        task=task.name,
    )


def _units(phase: Phase) -> list[Phase]:
    """A phase in parts of at most `UNIT_ROWS` rows; the last holds what is left, at least `MIN_ROWS`."""
    parts = []
    left = phase.rows
    while left > 0:
        rows = min(UNIT_ROWS, left)
        if 0 < left - rows < MIN_ROWS:
            rows -= MIN_ROWS
        parts.append(Phase(phase.steps, rows, phase.mean_return))
        left -= rows
    return parts


def _run(robot: Robot, series: Series, units: list[Phase], seed: int, workers: int) -> Iterator[tuple[int, Columns]]:
    """Yields (index of the unit, its rows) as they are done."""
    jobs = sorted(enumerate(units), key=lambda job: -job[1].rows)  # the longest first, so that all end together
    if workers <= 1:
        yield from ((index, _collect_unit(robot, series, unit, seed, index)) for index, unit in jobs)
        return
    context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    with ProcessPoolExecutor(min(workers, len(jobs)), context, end_with_parent) as pool:
        try:
            futures = {pool.submit(_collect_unit, robot, series, unit, seed, index): index for index, unit in jobs}
            for future in as_completed(futures):
                yield futures.pop(future), future.result()  # popped: a finished future holds its rows
        except BrokenProcessPool:
            raise UserError(
                f"One of {workers} collecting processes died: free some memory or use one worker, and in a script of "
                "your own call this under `if __name__ == '__main__':`."
            ) from None


def _collect_unit(robot: Robot, series: Series, unit: Phase, seed: int, index: int) -> Columns:
    """One unit of work, the same in any process: episodes in the order they began, the last one cut to fit."""
    *env_seeds, action_seed = np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(ENVIRONMENTS + 1).tolist()
    generator = torch.Generator().manual_seed(action_seed)
    with _one_thread():
        return record(robot, _policy(series, unit.steps), unit.rows, seeds=env_seeds, generator=generator)


def _policy(series: Series, steps: int) -> Policy:
    if steps > 0:
        return load_snapshot(series, steps)
    limit = torch.full((series.robot.action_dim,), series.robot.action_limit)
    return RandomPolicy(-limit, limit)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Small matrices gain nothing from threads, and sums split among threads round differently."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
