"""The zoo: snapshots of a learner act in MuJoCo, and what they live through becomes a dataset."""

import math
import multiprocessing
import platform
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import torch

from envtf_lit.data.dataset import OfflineDataset, starts_from_ends
from envtf_lit.data.recording import Columns, empty_columns, record
from envtf_lit.errors import UserError
from envtf_lit.hidden_dynamics import HIGH, LOW
from envtf_lit.policy import Policy, RandomPolicy, TanhGaussianActor
from envtf_lit.progress import progress_bar
from envtf_lit.storage import load_weights, read_json
from envtf_lit.tasks import ROBOTS, Robot, Task

ZOO = Path(__file__).parent.parent / "assets" / "zoo"
ENVIRONMENTS = 8  # per unit of work; a constant, since the policy's rounding may depend on the batch size
UNIT_ROWS = 24_000  # at most, per unit of work: three episodes of 1,000 steps in each environment, so none is wasted
MIN_ROWS = 2  # of a phase and of an episode
NOT_D4RL = "These are not D4RL's files: scores compare among themselves, not with D4RL's tables."
HIDDEN_DYNAMICS = (
    f"friction, mass and actuator strength are drawn in each episode, each uniform in [{LOW}, {HIGH}] times nominal, "
    "and are not observed; the policies were trained, and their returns measured, on the nominal robot"
)


@dataclass(frozen=True)
class Snapshot:
    """A learner's policy after `steps` environment steps, and what its deterministic actions returned."""

    steps: int
    mean_return: float
    return_std: float
    mean_length: float


@dataclass(frozen=True)
class Series:
    """A robot's snapshots along training, as a folder of safetensors and its `zoo.json` hold them.

    Attributes:
        robot: whose observations the snapshots know.
        folder: holds `zoo.json` and, for each snapshot, `<steps>.safetensors`.
        warm_up_steps: uniform random actions with which the learner began.
        trained_with: algorithm and settings, in words.
        architecture: of the `TanhGaussianActor`s.
        snapshots: in the order of their steps.
    """

    robot: Robot
    folder: Path
    warm_up_steps: int
    trained_with: str
    architecture: dict[str, Any]
    snapshots: tuple[Snapshot, ...]

    @cached_property
    def expert(self) -> Snapshot:
        """The snapshot of highest return."""
        return max(self.snapshots, key=lambda snapshot: snapshot.mean_return)

    @cached_property
    def medium(self) -> Snapshot:
        """The snapshot, up to the expert, whose return is nearest to a third of the expert's."""
        third = self.expert.mean_return / 3
        return min(self.up_to(self.expert), key=lambda snapshot: abs(snapshot.mean_return - third))

    def up_to(self, last: Snapshot) -> list[Snapshot]:
        """The snapshots of the learner's life until it became `last`, which is included."""
        return [snapshot for snapshot in self.snapshots if snapshot.steps <= last.steps]


def read_series(robot: Robot, zoo: Path | None = None) -> Series:
    """The snapshots of a robot (or of the robot it is a variant of).

    Args:
        robot: any of ours.
        zoo: a folder that `envtf zoo train` wrote; None takes the zoo that is part of this package.

    Raises:
        UserError: that folder has no (or no valid) series of this robot.
    """
    folder = (zoo or ZOO) / robot.name
    content = read_json(folder / "zoo.json")
    try:
        snapshots = tuple(Snapshot(**snapshot) for snapshot in content["snapshots"])
        known = {name: content[name] for name in ("warm_up_steps", "trained_with", "architecture")}
    except (KeyError, TypeError) as error:
        raise UserError(f"{folder}/zoo.json is not what `envtf zoo train` writes ({error}): train anew.") from None
    return Series(ROBOTS[robot.name], folder, snapshots=snapshots, **known)


def load_snapshot(series: Series, steps: int) -> TanhGaussianActor:
    """The behaviour policy after that many environment steps of training.

    Raises:
        UserError: its file is missing, damaged or of another shape.
    """
    robot = series.robot
    actor = TanhGaussianActor(robot.observation_dim, robot.action_dim, **series.architecture)
    load_weights(actor, series.folder / f"{steps:07d}.safetensors")
    return actor.eval()


@dataclass(frozen=True)
class Phase:
    """Consecutive rows of the dataset that one policy collects.

    Attributes:
        steps: environment steps the snapshot had been trained for; 0 is uniform random actions.
        rows: transitions to collect.
        mean_return: of the snapshot's deterministic actions; None for random actions.
    """

    steps: int
    rows: int
    mean_return: float | None


def plan(task: Task, transitions: int, series: Series | None = None) -> list[Phase]:
    """Who collects how much of a task's dataset, in this order.

    - `random`: uniform actions.
    - `medium`: the snapshot whose return is nearest to a third of the expert's.
    - `medium-replay`: the replay buffer of a learner that stops there: its random warm-up, then each snapshot with a
      share equal to the training steps since the snapshot before it.
    - `full-replay`: the same up to the expert, the snapshot of highest return.
    - `medium-expert`: half medium, half expert.
    - `expert`, which is none of the twenty tasks' tiers: the expert alone.

    Args:
        task: robot and tier.
        transitions: rows in all.
        series: the robot's snapshots; None takes the package's.

    Raises:
        UserError: `transitions` is too small to give every policy two rows.
    """
    series = series or read_series(task.robot)
    policies = _policies(task.tier, series)
    ends = np.array(list(accumulate(share for _, share in policies)))
    rows = np.diff(np.rint(ends / ends[-1] * transitions).astype(int), prepend=0)
    if rows.min() < MIN_ROWS:
        least = math.ceil(MIN_ROWS * ends[-1] / min(share for _, share in policies))
        raise UserError(
            f"{transitions} transitions are too few for the {len(policies)} policies of {task.name}: ask for {least} "
            "or more."
        )
    return [
        Phase(snapshot.steps if snapshot else 0, int(count), snapshot.mean_return if snapshot else None)
        for (snapshot, _), count in zip(policies, rows, strict=True)
    ]


def _policies(tier: str, series: Series) -> list[tuple[Snapshot | None, int]]:
    """A tier's policies (None acts at random) and their shares of the rows, in any unit."""
    if tier == "random":
        return [(None, 1)]
    if tier == "medium":
        return [(series.medium, 1)]
    if tier == "expert":
        return [(series.expert, 1)]
    if tier == "medium-expert":
        return [(series.medium, 1), (series.expert, 1)]
    learner = series.up_to(series.medium if tier == "medium-replay" else series.expert)
    ends = [series.warm_up_steps, *(snapshot.steps for snapshot in learner)]
    return list(zip([None, *learner], np.diff(ends, prepend=0).tolist(), strict=True))


def describe_origin(task: Task, transitions: int, seed: int, zoo: Path | None = None) -> dict[str, Any]:
    """How `collect` makes a dataset, for its card: policies with their returns and scores, seed, environment, versions.

    Two datasets of equal origin have equal bytes, on machines that round alike.
    """
    series, robot = read_series(task.robot, zoo), task.robot
    policies = [
        {
            "policy": f"snapshot after {phase.steps:,} steps" if phase.steps else "uniform random",
            "steps": phase.steps,
            "transitions": phase.rows,
            "mean_return_deterministic": phase.mean_return,
            "score_deterministic": None if phase.mean_return is None else robot.normalised_score(phase.mean_return),
        }
        for phase in plan(task, transitions, series)
    ]
    versions = {name: version(name) for name in ("gymnasium", "mujoco", "numpy", "torch")}
    hidden = {"hidden_dynamics": HIDDEN_DYNAMICS} if robot.hidden_dynamics else {}
    return {
        "seed": seed,
        "actions": "stochastic",
        "env_id": robot.env_id,
        "env_kwargs": robot.env_kwargs,
        **hidden,
        "policies": policies,
        "trained_with": series.trained_with,
        "versions": {**versions, "python": platform.python_version()},
        "note": f"Collected in {robot.env_id} by this package's own behaviour policies. {NOT_D4RL}",
    }


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
    with ProcessPoolExecutor(min(workers, len(jobs)), mp_context=context) as pool:
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
