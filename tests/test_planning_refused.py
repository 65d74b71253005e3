"""What planners refuse, each in a sentence: options out of range, other dimensions, and nothing to choose by."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from envtf_lit.errors import UserError
from envtf_lit.planning.options import CEMOptions, ICEMOptions, RandomShootingOptions
from envtf_lit.planning.shooting import RandomShooting
from envtf_lit.world_models.interface import Prediction
from envtf_lit.world_models.transformer import EnvironmentTransformer
from tests.analytic import LinearWorld, linear_data, linear_world
from tests.test_planning import BOUNDS, transformer


class Unpaid(LinearWorld):
    """A world that knows no reward."""

    def step(self, state: Tensor, action: Tensor, **options: Any) -> tuple[Tensor, Prediction]:
        following, prediction = super().step(state, action, **options)
        return following, replace(prediction, reward=torch.full_like(prediction.reward, torch.nan))


def refused(words: str, **given: Any) -> None:
    arguments: dict[str, Any] = dict(model=linear_world(), action_low=[-1.0], action_high=[1.0]) | given
    with pytest.raises(UserError, match=words):
        RandomShooting(**arguments)


def test_bad_input_ends_in_one_sentence():
    refused("horizon is 0, expected an integer, more than 0", options=RandomShootingOptions(horizon=0))
    refused("tail is 3.*there is none", options=RandomShootingOptions(tail=3))
    refused("discount is 2", options=RandomShootingOptions(discount=2.0))
    refused("2 low and 2 high limits.*actions of size 1", action_low=[-1.0] * 2, action_high=[1.0] * 2)
    refused("finite range", action_high=[float("inf")])
    with pytest.raises(UserError, match="elites is 20 and samples is 10"):
        CEMOptions(samples=10, elites=20)
    with pytest.raises(UserError, match=r"decay is 0\.5"):
        ICEMOptions(decay=0.5)


def test_a_planner_refuses_observations_that_are_none_of_its_episodes():
    planner = RandomShooting(linear_world(), [-1.0], [1.0], RandomShootingOptions(samples=4))
    with pytest.raises(UserError, match=r"observations of size 3.*shape \(2, 5\)"):
        planner.act(torch.zeros(2, 5))
    planner.act(torch.zeros(2, 3))
    with pytest.raises(UserError, match="follows 2 episodes and was given 3"):
        planner.act(torch.zeros(3, 3))
    planner.reset()
    assert planner.act(torch.zeros(3, 3)).shape == (3, 1)


def taught(rewards: list[float], predicted: float) -> EnvironmentTransformer:
    """A transformer that was trained on these rewards, and predicts one, in units of their scale about their mean."""
    model, data = transformer(), linear_data((2, 2))
    model.normaliser.fit(replace(data, rewards=np.array(rewards, np.float32)))
    model.head.weight.data[3].zero_()
    model.head.bias.data[3] = predicted
    return model


def falls(state: Tensor) -> Tensor:
    return state[..., 0] > 0


def test_where_nothing_is_paid_there_is_nothing_to_plan_for():
    options, seen = RandomShootingOptions(horizon=3, samples=8), torch.zeros(2, 3)
    plan = lambda model, **given: RandomShooting(model, *BOUNDS, options, **given).act(seen)  # noqa: E731
    for paid in (0.0, -2.5):
        model = taught([paid] * 4, 0.001)
        with pytest.raises(UserError, match=f"log pays {paid:g} at every step, so that no plan is better than another"):
            plan(model)
        assert plan(model, reward=lambda s, a, following: a[:, 0]).shape == (2, 1)
        assert plan(model, value=lambda s: s[:, 0]).shape == (2, 1)
    assert plan(taught([1.0] * 4, 0.0), terminated=falls).shape == (2, 1)  # it is paid until it falls
    with pytest.raises(UserError, match="log pays 0 at every step"):
        plan(taught([0.0] * 4, 0.0), terminated=falls)
    assert plan(taught([0.0, 1.0, 0.0, 1.0], -1.0)).shape == (2, 1)  # the same scale as of ones that are all a half
    assert plan(taught([0.0, 1.0, 2.0, 5.0], 0.0)).shape == (2, 1)


def test_a_planner_says_what_it_lacks():
    world, options = linear_world(), RandomShootingOptions(samples=4)
    with pytest.raises(UserError, match="No plan from observation 1 has a finite return"):
        RandomShooting(world, [-1.0], [1.0], options).act(torch.tensor([[0.0] * 3, [float("nan")] * 3]))
    with pytest.raises(UserError, match=r"No plan .* give a reward if the model has none"):
        RandomShooting(Unpaid(torch.eye(3), torch.ones(3, 1)), [-1.0], [1.0], options).act(torch.zeros(1, 3))
    with pytest.raises(UserError, match="no epistemic variance"):
        RandomShooting(world, [-1.0], [1.0], replace(options, novelty_limit=1.0)).act(torch.zeros(1, 3))
