"""The zoo: shipped snapshots of a learner act in MuJoCo, and what they live through becomes a dataset."""

import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import resources
from importlib.resources.abc import Traversable
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from envtf_lit.data.dataset import COLUMNS, OfflineDataset
from envtf_lit.errors import UserError
from envtf_lit.policy import Policy, RandomPolicy, TanhGaussianActor
from envtf_lit.storage import load_weights, read_json
from envtf_lit.tasks import Robot, Task

ZOO_TASKS = ("hopper-medium-replay",)
ENVIRONMENTS = 8  # per phase; a constant, since the policy's rounding may depend on the batch size
MIN_TRANSITIONS = 200

Episode = dict[str, np.ndarray]  # the columns of one episode, float32 and bool


@dataclass
class Trace:
    """An episode while it is lived: one tuple per transition, in the order of `COLUMNS`."""

    rows: list[tuple] = field(default_factory=list)
    finished: bool = False


@dataclass(frozen=True)
class Phase:
    """Consecutive rows of the dataset that one policy collects.

    Attributes:
        steps: environment steps the snapshot had been trained for; 0 is the learner's warm-up, uniform random actions.
        rows: transitions to collect.
        mean_return: of the snapshot's deterministic actions, when it was taken; None for the warm-up.
    """

    steps: int
    rows: int
    mean_return: float | None


def read_zoo(robot: Robot) -> dict[str, Any]:
    """What is known of a robot's snapshots: returns, architecture and how they were trained."""
    with resources.as_file(_zoo(robot) / "zoo.json") as path:
        return read_json(path)


def load_snapshot(robot: Robot, steps: int) -> TanhGaussianActor:
    """The behaviour policy after that many environment steps of training."""
    actor = TanhGaussianActor(robot.observation_dim, robot.action_dim, **read_zoo(robot)["architecture"])
    with resources.as_file(_zoo(robot) / f"{steps:07d}.safetensors") as path:
        load_weights(actor, path)
    return actor.eval()


def plan(task: Task, transitions: int) -> list[Phase]:
    """Who collects how much of a task's dataset, in the order of the learner's life.

    `medium-replay` mimics the replay buffer of a learner that stops at medium strength: its random warm-up, then each
    snapshot up to the medium one (nearest to a third of the expert's return) with a share equal to the training steps
    since the snapshot before it.

    Raises:
        UserError: the zoo has no such task, or `transitions` is too small to give every phase two rows.
    """
    if task.name not in ZOO_TASKS:
        raise UserError(
            f"The zoo has no snapshots for {task.name}: choose {', '.join(ZOO_TASKS)}, or set download.source to file."
        )
    if transitions < MIN_TRANSITIONS:
        raise UserError(f"download.transitions is {transitions}: the zoo needs at least {MIN_TRANSITIONS}.")
    zoo = read_zoo(task.robot)
    third = zoo["expert"]["mean_return"] / 3
    medium = min(zoo["snapshots"], key=lambda snapshot: abs(snapshot["mean_return"] - third))
    learner = [snapshot for snapshot in zoo["snapshots"] if snapshot["steps"] <= medium["steps"]]
    ends = np.array([zoo["warm_up_steps"], *(snapshot["steps"] for snapshot in learner)])
    row_ends = np.rint(ends / ends[-1] * transitions).astype(int)
    rows = [int(count) for count in np.diff(row_ends, prepend=0)]
    return [
        Phase(0, rows[0], None),
        *(Phase(s["steps"], count, s["mean_return"]) for s, count in zip(learner, rows[1:], strict=True)),
    ]


def collect(task: Task, transitions: int, *, seed: int, workers: int, progress: bool = True) -> OfflineDataset:
    """Lets the task's behaviour policies act in MuJoCo, with stochastic actions.

    The bytes depend on `seed` and `transitions`, not on `workers`: each phase of the plan is one unit of work with its
    own seeds, and phases are merged in order. Only the last episode of each phase is cut, and marked truncated.

    Args:
        task: one of `ZOO_TASKS`.
        transitions: rows of the dataset, exactly.
        seed: of the environments and the actions.
        workers: processes; above 1 a calling script needs its `if __name__ == "__main__":`.
        progress: shows a bar with the time left.

    Raises:
        UserError: the zoo has no such task, `transitions` is too small, or a worker process died.
    """
    phases = plan(task, transitions)
    episodes: list[list[Episode]] = [[] for _ in phases]
    with _progress_bar(transitions, task.name, progress) as advance:
        for index, collected in _run(task.robot, phases, seed, workers):
            episodes[index] = collected
            advance(phases[index].rows)
    return _merge([episode for unit in episodes for episode in unit], task)


def _zoo(robot: Robot) -> Traversable:
    return resources.files("envtf_lit") / "assets" / "zoo" / robot.name


def _run(robot: Robot, phases: list[Phase], seed: int, workers: int) -> Iterator[tuple[int, list[Episode]]]:
    """Yields (index of the phase, its episodes) as they are done."""
    jobs = sorted(enumerate(phases), key=lambda job: -job[1].rows)  # the longest first, so that all end together
    if workers <= 1:
        yield from ((index, _collect_phase(robot, phase, seed, index)) for index, phase in jobs)
        return
    context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    with ProcessPoolExecutor(min(workers, len(jobs)), mp_context=context) as pool:
        try:
            futures = {pool.submit(_collect_phase, robot, phase, seed, index): index for index, phase in jobs}
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BrokenProcessPool:
            raise UserError(
                f"One of {workers} collecting processes died: free some memory or use one worker, and in a script of "
                "your own call this under `if __name__ == '__main__':`."
            ) from None


def _collect_phase(robot: Robot, phase: Phase, seed: int, index: int) -> list[Episode]:
    """One unit of work, the same in any process: episodes in the order they began, the last one cut to fit."""
    *env_seeds, action_seed = np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(ENVIRONMENTS + 1).tolist()
    generator = torch.Generator().manual_seed(action_seed)
    with _one_thread():
        traces = _act(robot, _policy(robot, phase.steps), phase.rows, env_seeds, generator)
    return _cut(traces, phase.rows)


def _policy(robot: Robot, steps: int) -> Policy:
    if steps > 0:
        return load_snapshot(robot, steps)
    limit = torch.full((robot.action_dim,), robot.action_limit)
    return RandomPolicy(-limit, limit)


def _act(robot: Robot, policy: Policy, rows: int, seeds: list[int], generator: torch.Generator) -> list[Trace]:
    """Episodes in the order they began, enough of them for `rows`; all but the last are whole.

    Taking them in that order, not in the order they end, keeps short episodes from being over-represented.
    """
    envs = SyncVectorEnv(
        [lambda: gym.make(robot.env_id, **robot.env_kwargs)] * len(seeds), autoreset_mode=AutoresetMode.NEXT_STEP
    )
    current = [Trace() for _ in seeds]
    begun = list(current)
    observation, _ = envs.reset(seed=[*seeds])
    while sum(len(trace.rows) for trace in _usable(begun)) <= rows:
        action = policy.act(torch.as_tensor(observation, dtype=torch.float32), False, generator).numpy()
        following, reward, terminated, truncated, _ = envs.step(action)
        for index, trace in enumerate(current):
            if trace.finished:  # this step was the automatic reset, which is no transition: its action was ignored
                current[index] = Trace()
                begun.append(current[index])
                continue
            fell = bool(terminated[index])
            row = (observation[index], action[index], reward[index], following[index], fell)
            trace.rows.append((*row, bool(truncated[index]) and not fell))
            trace.finished = fell or bool(truncated[index])
        observation = following
    envs.close()
    return _usable(begun)


def _usable(begun: list[Trace]) -> list[Trace]:
    """The finished episodes up to the first running one, and that one, which can still be cut."""
    first_running = next((index for index, trace in enumerate(begun) if not trace.finished), len(begun))
    return begun[: first_running + 1]


def _cut(traces: list[Trace], rows: int) -> list[Episode]:
    """The first `rows` transitions of these episodes, which hold at least one more; a cut marks its row truncated."""
    episodes = []
    for trace in traces:
        take = min(len(trace.rows), rows)
        if rows - take == 1:  # a lone row is no episode: leave two for the next
            take -= 1
        if take == 0:
            break
        episode = _columns(trace.rows[:take])
        episode["truncated"][-1] = not episode["terminated"][-1]
        episodes.append(episode)
        rows -= take
    return episodes


def _columns(rows: list[tuple]) -> Episode:
    return {
        name: np.asarray(values, dtype=bool if name in ("terminated", "truncated") else np.float32)
        for name, values in zip(COLUMNS, zip(*rows, strict=True), strict=True)
    }


def _merge(episodes: list[Episode], task: Task) -> OfflineDataset:
    lengths = [len(episode["rewards"]) for episode in episodes]
    limit = np.full(task.robot.action_dim, task.robot.action_limit, dtype=np.float32)
    return OfflineDataset(
        **{name: np.concatenate([episode[name] for episode in episodes]) for name in COLUMNS},
        episode_starts=np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64),
        action_low=-limit,
        action_high=limit,
        task=task.name,
    )


@contextmanager
def _one_thread() -> Iterator[None]:
    """Small matrices gain nothing from threads, and sums split among threads round differently."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def _progress_bar(total: int, title: str, visible: bool) -> Iterator[Callable[[int], None]]:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=not visible) as bar:
        task = bar.add_task(f"Collecting {title}", total=total)
        yield lambda rows: bar.advance(task, rows)
