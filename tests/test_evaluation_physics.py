"""MuJoCo restarted at observations against episodes that Gymnasium recorded, and the ceiling that it sets."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from envtf_lit.data.dataset import OfflineDataset, starts_from_ends
from envtf_lit.errors import UserError
from envtf_lit.evaluation.physics import Physics, ceiling, perturbed
from envtf_lit.robots.tasks import ROBOTS, Robot, get_task
from envtf_lit.world_models.forecast import Scale, nmse, whole_episodes
from envtf_lit.zoo.snapshots import load_snapshot, read_series

STEPS = 80


@dataclass(frozen=True)
class Recorded:
    """Rows that an unbroken simulation lived through, in float64, and whether their state was observed whole."""

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    following: np.ndarray
    terminated: np.ndarray
    whole: np.ndarray
    starts: np.ndarray


def robot_of(name: str) -> Robot:
    return ROBOTS.get(name) or get_task(name).robot


@cache
def recorded(name: str) -> Recorded:
    """The first steps of three episodes of the zoo's medium policy, with noise."""
    robot = robot_of(name)
    series = read_series(robot)
    policy, generator = load_snapshot(series, series.medium.steps), torch.Generator().manual_seed(0)
    env, rows = robot.make(), []
    for episode in range(3):
        observation, _ = env.reset(seed=episode)
        for t in range(STEPS):
            action = policy.act(torch.from_numpy(observation).float()[None], False, generator)[0].numpy()
            velocity = env.unwrapped.data.qvel.copy()  # pyright: ignore[reportAttributeAccessIssue]
            whole = robot.name in ("halfcheetah", "ant") or bool(np.abs(velocity).max() < 10.0)
            following, reward, terminated, _, _ = env.step(action)
            rows.append((observation, action, float(reward), following, terminated, whole, t == 0))
            observation = following
            if terminated:
                break
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return Recorded(*columns[:-1], starts=np.flatnonzero(columns[-1]))


def as_dataset(rows: Recorded) -> OfflineDataset:
    ends = np.roll(np.isin(np.arange(len(rows.rewards)), rows.starts), -1)
    limit = np.ones(rows.actions.shape[1], np.float32)
    return OfflineDataset(
        observations=rows.observations.astype(np.float32),
        actions=rows.actions,
        rewards=rows.rewards.astype(np.float32),
        next_observations=rows.following.astype(np.float32),
        terminated=rows.terminated,
        truncated=ends & ~rows.terminated,
        episode_starts=starts_from_ends(ends),
        action_low=-limit,
        action_high=limit,
    )


@pytest.mark.parametrize("name", [*ROBOTS, "hopper-medium-v4"])
def test_a_step_from_an_observed_state_is_the_recorded_one(name: str) -> None:
    rows = recorded(name)
    physics = Physics(robot_of(name))
    following, rewards, terminated = physics.step(rows.observations[rows.whole], rows.actions[rows.whole])
    np.testing.assert_allclose(following, rows.following[rows.whole], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(terminated, rows.terminated[rows.whole])
    assert rows.whole.sum() > 30
    if name == "ant":  # a part of its reward looks back before the state
        error = np.abs(rewards - rows.rewards[rows.whole])
        assert np.median(error) < 0.01 and error.max() < 0.2
    else:
        np.testing.assert_allclose(rewards, rows.rewards[rows.whole], rtol=0, atol=1e-6)


def test_rounded_observations_err_by_little_more_than_their_rounding() -> None:
    for name in ROBOTS:
        rows = recorded(name)
        following, _, _ = Physics(ROBOTS[name]).step(
            rows.observations.astype(np.float32)[rows.whole], rows.actions[rows.whole]
        )
        error = np.abs(following - rows.following[rows.whole]).max(1)
        assert np.median(error) < 1e-6
        assert np.quantile(error, 0.9) < 1e-5


def test_clipped_velocities_are_lost() -> None:
    rows = recorded("walker2d")
    assert (~rows.whole).any()
    following, _, _ = Physics(ROBOTS["walker2d"]).step(rows.observations[~rows.whole], rows.actions[~rows.whole])
    assert np.abs(following - rows.following[~rows.whole]).max() > 0.01


def test_a_robot_knows_which_observations_are_clipped() -> None:
    for name in ROBOTS:
        rows = recorded(name)
        clipped = ROBOTS[name].clipped(torch.from_numpy(rows.observations)).numpy()
        np.testing.assert_array_equal(clipped, ~rows.whole)
    assert bool(get_task("hopper-medium-v4").robot.clipped(torch.full((11,), -10.0)))
    assert not bool(ROBOTS["ant"].clipped(torch.full((27,), 50.0)))


def test_ceilings_leave_out_trajectories_that_start_at_a_clipped_state() -> None:
    dataset = as_dataset(recorded("walker2d"))
    whole, scale, robot = whole_episodes(dataset, 3, seed=0), Scale.of(dataset), ROBOTS["walker2d"]
    starts = [whole.later(t) for t in range(20)]
    partly = next(late for late in starts if 0 < int(robot.clipped(late.observations[:, 0]).sum()) < len(late.lengths))
    clear = ~robot.clipped(partly.observations[:, 0])
    found = ceiling(Physics(robot), partly, scale, 0.0, seed=0)
    assert torch.equal(found.trajectories.lengths, partly.lengths[clear]) and len(found.error) == int(clear.sum())
    assert found.steps[0.1].censored == 1.0  # an undisturbed replay is the record
    with pytest.raises(UserError, match="Every trajectory of walker2d begins with a velocity that its observation"):
        ceiling(Physics(robot), partly.select(~clear), scale, 0.0, seed=0)


def test_rows_do_not_influence_each_other() -> None:
    rows, physics = recorded("ant"), Physics(ROBOTS["ant"])
    together = physics.step(rows.observations[:20], rows.actions[:20])
    order = np.random.default_rng(0).permutation(20)
    shuffled = physics.step(rows.observations[order], rows.actions[order])
    for a, b in zip(together, shuffled, strict=True):
        np.testing.assert_array_equal(a[order], b)


def test_an_orientation_need_not_be_a_unit_quaternion() -> None:
    rows, physics = recorded("ant"), Physics(ROBOTS["ant"])
    longer = rows.observations[:5].copy()
    longer[:, 1:5] *= 1.3
    for a, b in zip(
        physics.step(longer, rows.actions[:5]), physics.step(rows.observations[:5], rows.actions[:5]), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-9)


@pytest.mark.parametrize(("name", "height"), [("ant", 0), ("hopper", 0), ("halfcheetah", 0)])
def test_depth_is_how_far_a_body_stands_in_the_ground(name: str, height: int) -> None:
    rows, physics = recorded(name), Physics(ROBOTS[name])
    real = physics.depth(rows.observations)
    assert (real >= 0.0).all() and real.max() < 0.1  # contacts are soft
    raised, sunk = rows.observations[:20].copy(), rows.observations[:20].copy()
    raised[:, height] += 3.0
    sunk[:, height] -= 3.0
    assert (physics.depth(raised) == 0.0).all()
    deeper = sunk.copy()
    deeper[:, height] -= 0.5
    np.testing.assert_allclose(physics.depth(deeper) - physics.depth(sunk), 0.5, atol=1e-9)


def test_a_folded_robot_in_the_air_stands_in_nothing() -> None:
    folded = np.zeros((1, 11))
    folded[0, :4] = 4.0, 0.0, -2.5, -2.5  # height, and the joints of thigh and leg: hopper's own parts do collide
    assert Physics(ROBOTS["hopper"]).depth(folded).tolist() == [0.0]


def test_contact_forces_in_the_observation_are_no_state() -> None:
    robot, rows = get_task("ant-medium-105d").robot, recorded("ant")
    wide = np.column_stack([rows.observations[:5], np.full((5, 78), 3.0)])
    following, rewards, _ = Physics(robot).step(wide, rows.actions[:5])
    narrow = Physics(ROBOTS["ant"]).step(rows.observations[:5], rows.actions[:5])
    np.testing.assert_array_equal(following[:, :27], narrow[0])
    np.testing.assert_array_equal(rewards, narrow[1])
    assert following.shape == (5, 105)


def test_impossible_states_have_no_future(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    rows, physics = recorded("hopper"), Physics(ROBOTS["hopper"])
    states = rows.observations[:4].copy()
    states[1, 3], states[2, 7] = np.nan, 1e12
    following, rewards, terminated = physics.step(states, rows.actions[:4])
    for column in (following, rewards[:, None]):
        np.testing.assert_array_equal(np.isnan(column).all(1), [False, True, True, False])
    np.testing.assert_array_equal(terminated, [False, True, True, False])
    np.testing.assert_allclose(following[3], rows.following[3], atol=1e-6)
    assert list(tmp_path.iterdir()) == []  # no MUJOCO_LOG.TXT


def test_columns_of_another_robot_are_refused() -> None:
    with pytest.raises(UserError, match="11 and 3 columns, and these have 17 and 6"):
        Physics(ROBOTS["hopper"]).step(np.zeros((1, 17)), np.zeros((1, 6)))


def test_a_hidden_body_is_refused() -> None:
    with pytest.raises(UserError, match="walker2d-hidden has another body in each episode"):
        Physics(robot_of("walker2d-medium-hidden"))


def test_an_unbroken_replay_from_the_recorded_start_is_the_record() -> None:
    for name in ("hopper", "walker2d"):  # clipped velocities included: the simulator itself never loses them
        dataset = as_dataset(recorded(name))
        trajectories, scale = whole_episodes(dataset, 3, seed=0), Scale.of(dataset)
        starts = perturbed(trajectories, scale, 0.0, seed=0)
        error = nmse(Physics(ROBOTS[name]).replay(trajectories, starts, scale, beyond=1.0), trajectories, scale)
        assert error[trajectories.valid].max() < 1e-4


def test_the_ceiling_falls_as_the_start_is_further_off() -> None:
    dataset = as_dataset(recorded("ant"))
    trajectories, scale, physics = whole_episodes(dataset, 3, seed=0), Scale.of(dataset), Physics(ROBOTS["ant"])
    found = [ceiling(physics, trajectories, scale, size, seed=0).steps for size in (0.0, 1e-4, 1e-2, 0.3)]
    means = [steps[0.01].mean for steps in found]
    assert means == sorted(means, reverse=True)
    assert means[0] > means[-1] and means[-1] < 2
    assert all(steps[0.01].mean <= steps[0.1].mean for steps in found)
    assert all(steps[0.01].censored <= steps[0.1].censored for steps in found)


def test_a_replay_ends_where_it_has_left_the_threshold_behind() -> None:
    dataset = as_dataset(recorded("ant"))
    trajectories, scale, physics = whole_episodes(dataset, 2, seed=0), Scale.of(dataset), Physics(ROBOTS["ant"])
    starts = perturbed(trajectories, scale, 1e-2, seed=0)
    whole = nmse(physics.replay(trajectories, starts, scale, beyond=np.inf), trajectories, scale)
    ended = nmse(physics.replay(trajectories, starts, scale, beyond=0.1), trajectories, scale)
    assert torch.isfinite(whole[trajectories.valid]).all()
    for error, until in zip(whole, ended, strict=True):
        passed = int((error > 0.1).int().argmax())
        torch.testing.assert_close(error[: passed + 1], until[: passed + 1], rtol=0, atol=0)
        assert torch.isinf(until[passed + 1 :]).all()


def test_perturbations_have_the_size_asked_for_and_a_seed() -> None:
    dataset = as_dataset(recorded("halfcheetah"))
    trajectories, scale = whole_episodes(dataset, 3, seed=0), Scale.of(dataset)
    off = (perturbed(trajectories, scale, 0.5, seed=1) - trajectories.observations[:, 0].numpy()) / scale.std[
        :-1
    ].numpy()
    assert np.sqrt(np.square(off).mean()) == pytest.approx(0.5, rel=0.3)
    np.testing.assert_array_equal(
        perturbed(trajectories, scale, 0.5, seed=1), perturbed(trajectories, scale, 0.5, seed=1)
    )
    assert (perturbed(trajectories, scale, 0.5, seed=1) != perturbed(trajectories, scale, 0.5, seed=2)).all()
