"""The twenty tasks and their robots' variants: names, simulators, termination rules."""

import numpy as np
import pytest
import torch

from envtf_lit.errors import UserError
from envtf_lit.tasks import ROBOTS, TASKS, find_task, get_task

VARIANTS = [*(f"{name}-medium-v4" for name in ROBOTS), "ant-medium-105d"]


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


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("hopper-medum", "hopper-medium"),
        ("hopper-medium-v2", "hopper-medium"),  # D4RL's name
        ("hopper-medium-105d", "hopper-medium"),
        ("ant-medium-105d-v4", "ant-medium"),
    ],
)
def test_names_of_nothing_are_refused_with_a_hint(name: str, hint: str) -> None:
    assert find_task(name) is None
    with pytest.raises(UserError, match=f"{name}.*{hint}"):
        get_task(name)
