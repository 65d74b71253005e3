"""Value iteration through a world model, and the true pendulum that planners are compared on."""

from dataclasses import replace

import gymnasium
import pytest
import torch

from envtf_lit.errors import UserError
from envtf_lit.planning.pendulum import CHART, TruePendulum
from envtf_lit.planning.value_iteration import Axis, Chart, ValueIteration, ValueIterationOptions
from tests.analytic import LinearWorld, linear_world


def test_the_true_pendulum_is_gymnasiums():
    env, world = gymnasium.make("Pendulum-v1"), TruePendulum()
    observation, _ = env.reset(seed=0)
    state = torch.from_numpy(observation)[None]
    for torque in torch.linspace(-2.5, 2.5, 40):
        observation, paid, *_ = env.step(torque.reshape(1).numpy())
        state, prediction = world.step(state, torque.reshape(1, 1))
        torch.testing.assert_close(state[0], torch.from_numpy(observation), rtol=1e-4, atol=1e-4)
        assert prediction.reward.item() == pytest.approx(float(paid), rel=1e-3, abs=1e-4)
    assert env.reset(seed=1)[0].shape == (3,)


def test_value_iteration_solves_a_walk_along_a_line():
    """Steps of -1, 0, 1 between 0 and 4; each costs one until the end at 4, where nothing follows."""
    chart = Chart((Axis(0.0, 4.0, 5),), lambda point: point, lambda seen: seen)
    world = LinearWorld(torch.eye(1), torch.eye(1), observation_dim=1)
    found = ValueIteration(
        world,
        chart,
        [-1.0],
        [1.0],
        ValueIterationOptions(actions=3, discount=1.0),
        terminated=lambda s: s[..., 0] >= 4,
        reward=lambda s, a, following: -torch.ones(len(s)),
    )
    assert found.values.tolist() == [-4.0, -3.0, -2.0, -1.0, -1.0]
    assert found.act(torch.tensor([[0.0], [2.4]])).tolist() == [[1.0], [1.0]]
    assert found.value(torch.tensor([[0.5], [-3.0]])).tolist() == [-3.5, -4.0]


def test_a_circular_axis_goes_on_where_it_began():
    axis = Axis(0.0, 4.0, 4, circular=True)
    assert axis.points.tolist() == [0, 1, 2, 3]
    below, above, share = axis.place(torch.tensor([3.5, -0.25, 4.0]))
    assert (below.tolist(), above.tolist(), share.tolist()) == ([3, 3, 0], [0, 0, 1], [0.5, 0.75, 0.0])


def test_value_iteration_swings_the_pendulum_up():
    coarse = replace(CHART, axes=(replace(CHART.axes[0], count=41), replace(CHART.axes[1], count=41)))
    policy, world = (
        ValueIteration(TruePendulum(), coarse, [-2.0], [2.0], ValueIterationOptions(actions=5)),
        TruePendulum(),
    )
    state = torch.tensor([[-1.0, 0.0, 0.0]])
    for _ in range(150):
        state, _ = world.step(state, policy.act(state))
    assert state[0, 0] > 0.95


def test_value_iteration_says_what_it_lacks():
    chart = Chart((Axis(0.0, 4.0, 5),), lambda point: point, lambda seen: seen)
    world = LinearWorld(torch.eye(1), torch.eye(1), observation_dim=1)
    with pytest.raises(UserError, match=r"observations of size 1.*of 3 and 1"):
        ValueIteration(linear_world(), chart, [-1.0], [1.0])
    with pytest.raises(UserError, match="after 3 sweeps"):
        ValueIteration(world, chart, [-1.0], [1.0], ValueIterationOptions(sweeps=3))
    with pytest.raises(UserError, match="two actions"):
        ValueIteration(world, chart, [-1.0], [1.0], ValueIterationOptions(actions=1))
