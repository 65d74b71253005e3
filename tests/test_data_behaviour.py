"""The zoo: what is collected is made of true transitions, exactly as planned, whatever the number of processes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from envtf_lit.data.behaviour import (
    ENVIRONMENTS,
    ZOO_TASKS,
    Phase,
    Trace,
    _collect_phase,
    _cut,
    collect,
    load_snapshot,
    plan,
    read_zoo,
)
from envtf_lit.data.dataset import COLUMNS, OfflineDataset
from envtf_lit.data.formats import save_dataset
from envtf_lit.errors import UserError
from envtf_lit.tasks import TASKS, get_task

TASK = get_task("hopper-medium-replay")
ROWS = 2_000


@pytest.fixture(scope="module")
def dataset() -> OfflineDataset:
    return collect(TASK, ROWS, seed=0, workers=1, progress=False)


def test_size_and_types(dataset: OfflineDataset):
    assert len(dataset) == ROWS
    assert dataset.observations.shape == (ROWS, 11)
    assert dataset.actions.shape == (ROWS, 3)
    assert all(getattr(dataset, name).dtype == np.float32 for name in COLUMNS[:4])
    assert dataset.terminated.dtype == dataset.truncated.dtype == bool
    assert np.abs(dataset.actions).max() <= 1
    assert dataset.episode_lengths.min() >= 2


def test_no_autoreset_row_gets_in(dataset: OfflineDataset):
    """Such a row would lead from a final state to a reset state, with reward 0."""
    within = np.ones(ROWS, bool)
    within[dataset.episode_ends - 1] = False
    rows = np.flatnonzero(within)
    assert np.array_equal(dataset.next_observations[rows], dataset.observations[rows + 1])
    # Hopper starts at (0, 1.25, 0 ...) with positions and velocities off by at most 0.005
    start = np.array([1.25, *[0.0] * 10])
    assert np.abs(dataset.observations[dataset.episode_starts] - start).max() <= 0.005 + 1e-6
    first = np.zeros(ROWS, bool)
    first[dataset.episode_starts] = True
    assert not (np.abs(dataset.next_observations - start).max(axis=1) <= 0.005).any()


def test_episode_starts_differ(dataset: OfflineDataset):
    starts = dataset.observations[dataset.episode_starts]
    assert len(np.unique(starts, axis=0)) == len(starts)


def test_terminated_is_the_robots_rule_and_the_rest_is_cut(dataset: OfflineDataset):
    fell = TASK.robot.terminated(torch.from_numpy(dataset.next_observations)).numpy()
    assert np.array_equal(fell, dataset.terminated)
    last = dataset.episode_ends - 1
    ended = dataset.terminated | dataset.truncated
    assert ended.sum() == len(last)
    assert ended[last].all()
    assert not (dataset.terminated & dataset.truncated).any()
    assert 0 < dataset.truncated.sum() <= 2 * len(plan(TASK, ROWS))  # no episode of these reaches the time limit


def test_the_time_limit_truncates_and_keeps_the_true_final_state():
    robot = replace(TASK.robot, env_kwargs={"max_episode_steps": 6})
    episodes = _collect_phase(robot, Phase(0, 100, None), seed=0, index=0)
    assert [len(episode["rewards"]) for episode in episodes] == [6] * 16 + [4]
    for episode in episodes:
        assert episode["truncated"].tolist() == [False] * (len(episode["rewards"]) - 1) + [True]
        assert not episode["terminated"].any()
        change = np.abs(episode["next_observations"] - episode["observations"]).max(axis=1)
        assert change[-1] > 0.1  # random actions kick the joints; a reset state would be still
        assert np.abs(episode["next_observations"][-1, 5:]).max() > 0.1


def test_bytes_do_not_depend_on_the_number_of_processes(tmp_path: Path):
    for workers in (1, 2):
        save_dataset(collect(TASK, 300, seed=0, workers=workers, progress=False), tmp_path / f"{workers}.h5")
    assert (tmp_path / "1.h5").read_bytes() == (tmp_path / "2.h5").read_bytes()


def test_seed_matters():
    first, second, again = (_collect_phase(TASK.robot, plan(TASK, 200)[1], seed, index=1) for seed in (0, 1, 0))
    assert not np.array_equal(first[0]["actions"][:2], second[0]["actions"][:2])
    assert not np.array_equal(first[0]["observations"][:2], second[0]["observations"][:2])
    assert all(np.array_equal(first[0][name], again[0][name]) for name in COLUMNS)


def test_plan_covers_the_learners_life():
    phases = plan(TASK, 150_000)
    assert [phase.steps for phase in phases] == [0, *range(10_000, 100_001, 10_000), 125_000, 150_000]
    assert [phase.rows for phase in phases] == [5_000, 5_000, *[10_000] * 9, 25_000, 25_000]
    assert phases[-1].mean_return == min(
        (phase.mean_return for phase in phases if phase.mean_return), key=lambda value: abs(value - 3220 / 3)
    )


@pytest.mark.parametrize("transitions", [200, 1_234, 100_000])
def test_plan_adds_up(transitions: int):
    rows = [phase.rows for phase in plan(TASK, transitions)]
    assert sum(rows) == transitions
    assert min(rows) >= 2


@pytest.mark.parametrize("name", sorted(set(TASKS) - set(ZOO_TASKS)))
def test_other_tasks_are_refused(name: str):
    with pytest.raises(UserError, match=f"no snapshots for {name}.*hopper-medium-replay"):
        collect(get_task(name), ROWS, seed=0, workers=1, progress=False)


def test_too_few_transitions_are_refused():
    with pytest.raises(UserError, match="transitions is 13"):
        collect(TASK, 13, seed=0, workers=1, progress=False)


def test_snapshots_act_and_differ():
    observation = torch.zeros(ENVIRONMENTS, 11)
    observation[:, 0] = 1.25
    actions = [load_snapshot(TASK.robot, s["steps"]).act(observation)[0] for s in read_zoo(TASK.robot)["snapshots"]]
    assert len(torch.unique(torch.stack(actions), dim=0)) == len(actions)
    assert torch.stack(actions).abs().max() <= 1


def trace(length: int, *, terminated: bool) -> Trace:
    rows = [(np.zeros(2), np.zeros(1), 1.0, np.zeros(2), terminated and i == length - 1, False) for i in range(length)]
    return Trace(rows, finished=terminated)


@pytest.mark.parametrize(
    ("rows", "lengths", "truncated"),
    [
        (5, [5], [False]),  # exactly one whole episode
        (7, [5, 2], [False, True]),  # the second one is cut
        (6, [4, 2], [True, True]),  # a lone row is no episode: the first one gives one up
    ],
)
def test_cut(rows: int, lengths: list[int], truncated: list[bool]):
    episodes = _cut([trace(5, terminated=True), trace(4, terminated=False)], rows)
    assert [len(episode["rewards"]) for episode in episodes] == lengths
    assert [bool(episode["truncated"][-1]) for episode in episodes] == truncated
    assert [bool(episode["terminated"][-1]) for episode in episodes] == [not cut for cut in truncated]
