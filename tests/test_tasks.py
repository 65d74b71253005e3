"""The twenty tasks and their robots' variants: names, simulators, termination rules."""

from typing import Any

import numpy as np
import pytest
import torch

from envtf_lit.errors import UserError
from envtf_lit.robots.hidden_dynamics import Factors, HiddenDynamics
from envtf_lit.robots.tasks import ROBOTS, TASKS, find_task, get_task

VARIANTS = [*(f"{name}-medium{variant}" for name in ROBOTS for variant in ("-v4", "-hidden")), "ant-medium-105d"]


def test_there_are_twenty() -> None:
    assert len(TASKS) == 20
    assert all(get_task(name) is task and task.name == name for name, task in TASKS.items())


@pytest.mark.parametrize("name", [*(f"{name}-medium" for name in ROBOTS), *VARIANTS])
def test_simulators_fit_what_is_said_of_them(name: str) -> None:
    task = get_task(name)
    assert task.name == name
    env = task.robot.make()
    observation, _ = env.reset(seed=0)
    assert observation.shape == (task.robot.observation_dim,)
    assert env.action_space.shape == (task.robot.action_dim,)
    np.testing.assert_array_equal(env.action_space.high, task.robot.action_limit)  # pyright: ignore
    assert env.spec is not None
    assert env.spec.id == task.robot.env_id
    assert env.spec.id.endswith("-v4") == name.endswith("-v4")
    assert env.spec.max_episode_steps == task.robot.max_episode_steps
    assert not task.robot.terminated(torch.tensor(observation, dtype=torch.float32)).any()


def test_the_first_dimensions_of_the_large_ant_are_those_of_the_small_one() -> None:
    small, large = (get_task(name).robot.make() for name in ("ant-medium", "ant-medium-105d"))
    action = np.full(8, 0.5, dtype=np.float32)
    for _ in range(2):
        observations = [env.reset(seed=3)[0] for env in (small, large)]
        np.testing.assert_array_equal(observations[0], observations[1][:27])
        steps = [env.step(action) for env in (small, large)]
        np.testing.assert_array_equal(steps[0][0], steps[1][0][:27])
        assert steps[0][1] == steps[1][1]


@pytest.mark.parametrize("name", ROBOTS)
def test_rules_agree_with_the_simulator_wherever_the_robot_is_put(name: str) -> None:
    """Far beyond every limit and close to it, on both sides of zero: the published copies miss the latter."""
    robot, rng = ROBOTS[name], np.random.default_rng(0)
    env: Any = robot.make().unwrapped
    env.reset(seed=0)
    position, fell = env.init_qpos.copy(), list[bool]()
    for k in range(1_000):
        env.reset_model()
        spread = (0.02, 0.3, 1.0, 150.0)[k % 4]
        moved = position + spread * rng.normal(size=len(position)) * (rng.random(len(position)) < 0.3)
        env.set_state(moved, rng.normal(size=len(env.init_qvel)))
        observation = torch.tensor(env._get_obs())
        fell.append(not getattr(env, "is_healthy", True))
        assert bool(robot.terminated(observation)) == fell[-1]
    assert (name == "halfcheetah") == (not any(fell)) and not all(fell)


@pytest.mark.parametrize(
    ("task", "survives"), [("hopper-medium", 0.0), ("hopper-medium-v4", 1.0), ("ant-medium", None)]
)
def test_rewards_differ_between_versions_as_the_docs_say(task: str, survives: float | None) -> None:
    """Of a fall's own step, and of the contacts that our Ant doesn't observe."""
    env, rng, costs = get_task(task).robot.make(), np.random.default_rng(0), []
    env.reset(seed=0)
    for _ in range(200):
        _, reward, terminated, _, info = env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
        costs.append(-info.get("reward_contact", 0.0))
        if terminated and survives is not None:
            break
    if survives is None:
        assert 0.0 < max(costs) <= 78 * 5e-4
    else:
        shaped = info["x_velocity"] + survives
        assert terminated and float(reward) == pytest.approx(shaped, abs=3.1e-3)  # and at most that for control


def test_a_coordinate_below_minus_a_hundred_ends_hoppers_episode() -> None:
    upright = torch.tensor([1.25, *(10 * [0.0])])
    for value, fell in ((99.0, False), (-99.0, False), (101.0, True), (-101.0, True)):
        observation = upright.clone()
        observation[3] = value
        assert bool(ROBOTS["hopper"].terminated(observation)) is fell


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("hopper-medum", "hopper-medium"),
        ("hopper-medium-v2", "hopper-medium"),  # D4RL's name
        ("hopper-medium-105d", "hopper-medium"),
        ("ant-medium-105d-v4", "ant-medium"),
        ("ant-medium-105d-hidden", "ant-medium"),
    ],
)
def test_names_of_nothing_are_refused_with_a_hint(name: str, hint: str) -> None:
    assert find_task(name) is None
    with pytest.raises(UserError, match=f"{name}.*{hint}"):
        get_task(name)


# robots whose dynamics are hidden

HIDDEN = [f"{name}-medium-replay-hidden" for name in ("hopper", "halfcheetah", "walker2d")]


def hidden(name: str) -> HiddenDynamics:
    env = get_task(name).robot.make()
    assert isinstance(env, HiddenDynamics)
    return env


@pytest.mark.parametrize("name", HIDDEN)
def test_hidden_dynamics_are_drawn_anew_in_each_episode_from_the_seed(name: str) -> None:
    env, twin = hidden(name), hidden(name)
    assert env.factors == Factors()
    drawn = [env.reset(seed=5) and env.factors, *(env.reset() and env.factors for _ in range(9))]
    again = [twin.reset(seed=5) and twin.factors, *(twin.reset() and twin.factors for _ in range(9))]
    assert drawn == again
    values = np.array([(f.friction, f.mass, f.strength) for f in drawn])
    assert len(np.unique(values)) == 30
    assert 0.5 <= values.min() < 0.7 and 1.3 < values.max() <= 1.5
    assert np.abs(values.mean() - 1.0) < 0.2


@pytest.mark.parametrize("name", HIDDEN)
def test_factors_multiply_the_nominal_robot_and_leave_the_start_as_it_is(name: str) -> None:
    nominal, env = get_task(name.removesuffix("-hidden")).robot.make(), hidden(name)
    start, _ = nominal.reset(seed=1)
    np.testing.assert_array_equal(env.reset(seed=1)[0], start)
    for _ in range(3):  # factors are of the nominal robot, not of the one before
        env.reset()
    plain, mine = (e.unwrapped.model for e in (nominal, env))  # pyright: ignore
    f = env.factors
    np.testing.assert_array_equal(mine.geom_friction, f.friction * plain.geom_friction)
    np.testing.assert_array_equal(mine.body_mass, f.mass * plain.body_mass)
    np.testing.assert_array_equal(mine.body_inertia, f.mass * plain.body_inertia)
    np.testing.assert_array_equal(mine.actuator_gear, f.strength * plain.actuator_gear)
    assert mine.body_subtreemass[0] == pytest.approx(f.mass * plain.body_subtreemass[0])  # what MuJoCo derives


def test_with_factors_of_one_the_robot_is_the_nominal_one() -> None:
    nominal, env = get_task("halfcheetah-medium").robot.make(), hidden("halfcheetah-medium-hidden")
    rng = np.random.default_rng(0)
    for e in (nominal, env):
        e.reset(seed=2)
    env.apply(Factors())
    for action in rng.uniform(-1, 1, (20, 6)).astype(np.float32):
        assert env.step(action)[0] == pytest.approx(nominal.step(action)[0], abs=1e-6)
    env.apply(Factors(strength=0.5))
    action = np.ones(6, np.float32)
    assert np.abs(env.step(action)[0] - nominal.step(action)[0]).max() > 0.01
