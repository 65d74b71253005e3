"""The zoo: what is collected is made of true transitions, exactly as planned, whatever the number of processes."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from envtf_lit.data.dataset import COLUMNS, OfflineDataset, starts_from_ends
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.errors import UserError
from envtf_lit.robots.returns import evaluate_policy
from envtf_lit.robots.tasks import ROBOTS, TASKS, TIERS, Robot, get_task
from envtf_lit.zoo.collect import ENVIRONMENTS, UNIT_ROWS, _collect_unit, _units, collect
from envtf_lit.zoo.snapshots import ZOO, Phase, describe_origin, load_snapshot, plan, read_series

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


@pytest.mark.parametrize("name", ["walker2d-random", "halfcheetah-random", "ant-random"])
def test_rows_of_every_robot_follow_one_another(name: str):
    """Episodes that end by a fall, by a time limit of 30 steps, and by the cut; no row leads to a reset state."""
    robot = replace(get_task(name).robot, max_episode_steps=30)
    columns = _collect_unit(robot, read_series(robot), Phase(0, 400, None), seed=0, index=0)
    ended = columns["terminated"] | columns["truncated"]
    assert ended[-1]
    same = (columns["next_observations"][:-1] == columns["observations"][1:]).all(axis=1)
    assert np.array_equal(same, ~ended[:-1])
    fell = robot.terminated(torch.from_numpy(columns["next_observations"])).numpy()
    assert np.array_equal(fell, columns["terminated"])
    assert fell.any() == (name != "halfcheetah-random")  # which never falls
    lengths = np.diff(starts_from_ends(ended), append=400)
    assert (lengths[~fell[ended]][:-1] == 30).all()
    velocity = np.abs(columns["next_observations"][ended][:, -robot.action_dim :]).max(axis=1)
    assert (velocity > 1.0).all()  # of joints in motion; after a reset it is below 0.5


def test_the_time_limit_truncates_and_keeps_the_true_final_state():
    robot = replace(TASK.robot, max_episode_steps=6)
    columns = _collect_unit(robot, read_series(robot), Phase(0, 100, None), seed=0, index=0)
    ends = np.flatnonzero(columns["truncated"])
    assert ends.tolist() == [*range(5, 96, 6), 99]
    assert not columns["terminated"].any()
    change = np.abs(columns["next_observations"] - columns["observations"]).max(axis=1)
    assert (change[ends] > 0.1).all()  # random actions kick the joints; a reset state would be still
    assert (np.abs(columns["next_observations"][ends, 5:]).max(axis=1) > 0.1).all()


def test_bytes_do_not_depend_on_the_number_of_processes(tmp_path: Path):
    for workers in (1, 2):
        save_dataset(collect(TASK, 300, seed=0, workers=workers, progress=False), tmp_path / f"{workers}.h5")
    assert (tmp_path / "1.h5").read_bytes() == (tmp_path / "2.h5").read_bytes()


def test_a_dataset_of_many_units_does_not_depend_on_their_order(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("envtf_lit.zoo.collect.UNIT_ROWS", 100)
    task = get_task("hopper-medium-expert")
    forwards = collect(task, 240, seed=0, workers=1, progress=False)
    monkeypatch.setattr("envtf_lit.zoo.collect.sorted", lambda jobs, key: list(jobs)[::-1], raising=False)
    backwards = collect(task, 240, seed=0, workers=1, progress=False)
    assert all(np.array_equal(getattr(forwards, name), getattr(backwards, name)) for name in COLUMNS)
    alone = collect(get_task("hopper-medium"), 120, seed=0, workers=1, progress=False)
    assert np.array_equal(forwards.observations[:120], alone.observations)  # the same policy with the same seeds


def test_seed_matters():
    series = read_series(TASK.robot)
    unit = plan(TASK, 200)[1]
    first, second, again = (_collect_unit(TASK.robot, series, unit, seed, index=1) for seed in (0, 1, 0))
    assert not np.array_equal(first["actions"][:2], second["actions"][:2])
    assert not np.array_equal(first["observations"][:2], second["observations"][:2])
    assert all(np.array_equal(first[name], again[name]) for name in COLUMNS)


@pytest.mark.slow
def test_the_pipelines_dataset_is_the_one_that_results_were_published_on(tmp_path: Path):
    save_dataset(collect(TASK, 100_000, seed=0, workers=2, progress=False), tmp_path / "dataset.h5")
    found = hashlib.sha256((tmp_path / "dataset.h5").read_bytes()).hexdigest()
    # on x86-64 with AVX-512, mujoco 4.0.0 and torch 2.13.0; elsewhere sums may round differently
    assert found == "7296bf05d9cb86b39dd202f941f98cfce2f226d7e73f19fe4ea5a93a9e71db8a"


def test_plan_of_a_replay_covers_the_learners_life():
    phases = plan(TASK, 150_000)
    assert [phase.steps for phase in phases] == [0, *range(10_000, 100_001, 10_000), 125_000, 150_000]
    assert [phase.rows for phase in phases] == [5_000, 5_000, *[10_000] * 9, 25_000, 25_000]


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_tiers_are_made_of_the_right_policies(robot: Robot):
    series = read_series(robot)
    phases = {tier: plan(get_task(f"{robot.name}-{tier}"), 100_000) for tier in TIERS}
    best = max(snapshot.mean_return for snapshot in series.snapshots)
    medium, expert = series.medium, series.expert
    assert expert.mean_return == best
    early = [s for s in series.snapshots if s.steps <= expert.steps]
    assert all(abs(medium.mean_return - best / 3) <= abs(s.mean_return - best / 3) for s in early)
    assert phases["random"] == [Phase(0, 100_000, None)]
    assert phases["medium"] == [Phase(medium.steps, 100_000, medium.mean_return)]
    assert [(phase.steps, phase.rows) for phase in phases["medium-expert"]] == [
        (medium.steps, 50_000),
        (expert.steps, 50_000),
    ]
    for tier, last in (("medium-replay", medium), ("full-replay", expert)):
        assert [phase.steps for phase in phases[tier]] == [0, *(s.steps for s in early if s.steps <= last.steps)]
        ends = np.cumsum([phase.rows for phase in phases[tier]])
        steps = np.array([series.warm_up_steps, *(phase.steps for phase in phases[tier][1:])])
        np.testing.assert_allclose(ends / 100_000, steps / last.steps, atol=1e-5)


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("transitions", [1_234, 100_000, 1_000_000])
def test_plan_adds_up(name: str, transitions: int):
    phases = plan(TASKS[name], transitions)
    assert sum(phase.rows for phase in phases) == transitions
    assert min(phase.rows for phase in phases) >= 2
    units = [unit for phase in phases for unit in _units(phase)]
    assert sum(unit.rows for unit in units) == transitions
    assert {phase.steps for phase in phases} == {unit.steps for unit in units}
    assert min(unit.rows for unit in units) >= 2
    assert max(unit.rows for unit in units) <= UNIT_ROWS


@pytest.mark.parametrize("rows", [2, 3, UNIT_ROWS, UNIT_ROWS + 1, 2 * UNIT_ROWS + 2])
def test_units_are_no_episode_of_one_row(rows: int):
    units = _units(Phase(7, rows, 1.0))
    assert sum(unit.rows for unit in units) == rows
    assert min(unit.rows for unit in units) >= 2


def test_too_few_transitions_are_refused():
    with pytest.raises(UserError, match=r"13 transitions are too few .* ask for \d+ or more"):
        collect(TASK, 13, seed=0, workers=1, progress=False)


@pytest.mark.parametrize("name", ["hopper-medium-v4", "ant-medium-v4", "ant-medium-105d", "ant-random-105d"])
def test_variants_are_driven_by_the_same_policies(name: str):
    task = get_task(name)
    dataset = collect(task, 60, seed=0, workers=1, progress=False)
    assert dataset.task == name
    assert dataset.observations.shape == dataset.next_observations.shape == (60, task.robot.observation_dim)
    usual = collect(get_task(f"{task.robot.name}-{task.tier}"), 60, seed=0, workers=1, progress=False)
    common = usual.observation_dim
    # the same start and the same first action; what follows differs in -v4 alone
    same = 60 if name.endswith("105d") else 1
    np.testing.assert_array_equal(dataset.actions[:same], usual.actions[:same])
    np.testing.assert_array_equal(dataset.observations[:same, :common], usual.observations[:same])
    if name.endswith("105d"):
        assert np.abs(dataset.next_observations[:, 27:]).max() > 0  # contact forces


def test_episodes_of_hidden_dynamics_differ_from_their_first_action_on_and_are_the_seeds():
    task = get_task("walker2d-medium-hidden")
    dataset = collect(task, 400, seed=0, workers=1, progress=False)
    usual = collect(get_task("walker2d-medium"), 60, seed=0, workers=1, progress=False)
    np.testing.assert_array_equal(dataset.observations[0], usual.observations[0])
    assert np.abs(dataset.next_observations[0] - usual.next_observations[0]).max() > 1e-3
    again = collect(task, 400, seed=0, workers=1, progress=False)
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(dataset, name), getattr(again, name))
    origin = describe_origin(task, 400, 0)
    assert "friction, mass and actuator strength" in origin["hidden_dynamics"]
    assert "hidden_dynamics" not in describe_origin(TASK, ROWS, 0)


def test_origin_names_every_policy_and_version():
    origin = describe_origin(get_task("ant-medium-expert"), 1_000, 3)
    assert [policy["transitions"] for policy in origin["policies"]] == [500, 500]
    assert origin["policies"][1]["score_deterministic"] > 70
    assert origin["env_kwargs"] == {"include_cfrc_ext_in_observation": False}
    assert (origin["env_id"], origin["seed"]) == ("Ant-v5", 3)
    assert set(origin["versions"]) == {"gymnasium", "mujoco", "numpy", "torch", "python"}
    assert "not D4RL's files" in origin["note"]


# the shipped snapshots


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_snapshots_act_and_differ(robot: Robot):
    series = read_series(robot)
    observation, _ = robot.make().reset(seed=0)
    batch = torch.tensor(observation, dtype=torch.float32).expand(ENVIRONMENTS, -1)
    actions = [load_snapshot(series, s.steps).act(batch)[0] for s in series.snapshots]
    assert len(torch.unique(torch.stack(actions), dim=0)) == len(actions)
    assert torch.stack(actions).abs().max() <= 1
    files = {path.stem for path in series.folder.glob("*.safetensors")}
    assert files == {f"{s.steps:07d}" for s in series.snapshots}


def test_the_zoo_is_small():
    assert sum(path.stat().st_size for path in ZOO.rglob("*") if path.is_file()) <= 12_000_000


def check_returns(robot: Robot, steps: int, episodes: int) -> None:
    """Falls make a mean return uncertain, rounding on another machine even more: five standard errors and 5 %."""
    series = read_series(robot)
    recorded = next(snapshot for snapshot in series.snapshots if snapshot.steps == steps)
    found = evaluate_policy(load_snapshot(series, steps), robot, episodes=episodes, seed=0, progress=False)
    allowed = 5 * recorded.return_std / np.sqrt(episodes) + 0.05 * abs(recorded.mean_return)
    assert abs(found.returns.mean() - recorded.mean_return) <= allowed


@pytest.mark.parametrize(("name", "score"), [("hopper", 90), ("halfcheetah", 90), ("walker2d", 80), ("ant", 80)])
def test_experts_are_experts(name: str, score: float):
    assert ROBOTS[name].normalised_score(read_series(ROBOTS[name]).expert.mean_return) >= score


@pytest.mark.parametrize("robot", [ROBOTS["halfcheetah"]], ids=lambda robot: robot.name)
def test_experts_return_what_is_recorded(robot: Robot):
    check_returns(robot, read_series(robot).expert.steps, episodes=2)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_all_snapshots_return_what_is_recorded(robot: Robot):
    for snapshot in read_series(robot).snapshots:
        check_returns(robot, snapshot.steps, episodes=20)


@pytest.mark.parametrize(
    ("content", "message"), [(None, "does not exist"), ("{}", "not what `envtf zoo train` writes")]
)
def test_a_folder_that_is_no_zoo_is_refused(content: str | None, message: str, tmp_path: Path):
    if content is not None:
        (tmp_path / "hopper").mkdir()
        (tmp_path / "hopper/zoo.json").write_text(content)
    with pytest.raises(UserError, match=message):
        read_series(TASK.robot, tmp_path)
