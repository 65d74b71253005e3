"""The gradient of imagined returns: paths, their value by hand, and an actor that climbs a world it can work out."""

import copy
from dataclasses import replace
from typing import Any

import pytest
import torch
from analytic import linear_data, linear_world
from torch import Tensor, nn

from envtf_lit.agents.cql import CQL
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.value_gradient import Paths, ValueGradient
from envtf_lit.errors import UserError
from envtf_lit.imagination.options import ImaginationOptions, ValueGradientOptions
from envtf_lit.imagination.rollouts import Imagination
from envtf_lit.pipeline.params import build_params

OPTIONS = ValueGradientOptions(updates=4, rollouts=6, horizon=3, max_steps=9, trace=0.5, value_passes=2)
ONE = torch.ones(())


class Constant(nn.Module):
    """An actor that always takes the same action, and a state value that is the same everywhere."""

    def __init__(self, value: float) -> None:
        super().__init__()
        self.level = nn.Parameter(torch.tensor(value))

    def sample(self, observation: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        return self.level.expand(len(observation), 1), torch.zeros(len(observation))

    def forward(self, observation: Tensor) -> Tensor:
        return self.level.expand(observation.shape[:-1])


def make_gradient(value: float = 0.0, **options) -> ValueGradient:
    gradient = ValueGradient(3, replace(OPTIONS, **options))
    gradient.value = gradient.target_value = Constant(value)  # pyright: ignore[reportAttributeAccessIssue]
    return gradient


def make_imagination(fall_beyond: float = float("inf"), history: int = 2) -> Imagination:
    options = ImaginationOptions(history=history, mode="mean", posterior=0.0, novelty_limit=None)
    return Imagination(linear_world(), linear_data((30, 40)), lambda s: s[:, 0] > fall_beyond, options)


def hand_made() -> Paths:
    """Two rollouts of three steps; the second falls at its second step."""
    fell = torch.tensor([[False, False], [False, True], [False, False]])
    rewards = torch.tensor([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])
    states = torch.zeros(3, 2, 3)
    return Paths(states, torch.zeros(3, 2, 1), rewards, states, fell)


def test_a_paths_return_ends_with_the_fall_and_else_with_the_states_value():
    returns = make_gradient(value=10.0).imagined_return(hand_made(), discount=0.5)
    torch.testing.assert_close(returns, torch.tensor([1.0 + 1.0 + 0.75 + 0.125 * 10.0, 1.0 + 1.0]))


@pytest.mark.parametrize("trace", [0.0, 0.5, 1.0])
def test_value_targets_are_td_lambda(trace):
    targets = make_gradient(value=10.0, trace=trace).value_targets(hand_made(), discount=0.5)
    last = 3.0 + 0.5 * 10.0
    middle = 2.0 + 0.5 * ((1 - trace) * 10.0 + trace * last)
    first = 1.0 + 0.5 * ((1 - trace) * 10.0 + trace * middle)
    torch.testing.assert_close(targets[:, 0], torch.tensor([first, middle, last]))
    torch.testing.assert_close(targets[:2, 1], torch.tensor([1.0 + 0.5 * ((1 - trace) * 10.0 + trace * 2.0), 2.0]))


def test_steps_after_a_fall_teach_nothing():
    paths = replace(hand_made(), rewards=torch.tensor([[1.0, 1.0], [2.0, 2.0], [3.0, 1e6]]))
    gradient, generator = make_gradient(value=10.0, value_passes=3), torch.Generator().manual_seed(0)
    lessons = list(gradient.lessons(paths, 0.5, generator))
    assert sum(len(states) for states, _ in lessons) == 3 * 5
    assert max(float(targets.max()) for _, targets in lessons) < 100.0


def test_the_gradient_through_the_world_equals_finite_differences():
    def value(level: float) -> tuple[Tensor, Constant]:
        actor = Constant(level)
        paths = make_gradient(value=2.0).paths(
            actor,  # pyright: ignore[reportArgumentType]
            make_imagination(),
            ONE,
            torch.Generator().manual_seed(0),
        )
        return make_gradient(value=2.0).imagined_return(paths, 0.9).mean(), actor

    middle, actor = value(0.3)
    middle.backward()
    slope = ((value(0.4)[0] - value(0.2)[0]) / 0.2).detach()
    assert actor.level.grad is not None and abs(float(slope)) > 0.01
    torch.testing.assert_close(actor.level.grad, slope, rtol=1e-3, atol=1e-5)


def test_rollouts_go_on_where_they_stood_until_they_are_old():
    gradient, imagination, generator = make_gradient(max_steps=6), make_imagination(), torch.Generator().manual_seed(0)
    actor: Any = Constant(0.1)
    first, second, third = (gradient.paths(actor, imagination, ONE, generator) for _ in range(3))
    torch.testing.assert_close(second.observations[0], first.next_observations[-1])
    assert not torch.isclose(third.observations[0], second.next_observations[-1]).all(-1).any()


def test_the_fallen_begin_anew_at_real_states():
    imagination = make_imagination(fall_beyond=-1e9)  # every robot falls at once
    gradient, generator, actor = make_gradient(), torch.Generator().manual_seed(0), Constant(0.1)
    real = torch.as_tensor(linear_data((30, 40)).observations)
    for _ in range(2):
        paths = gradient.paths(actor, imagination, ONE, generator)  # pyright: ignore[reportArgumentType]
        assert paths.alive[1:].sum() == 0
        starts = paths.observations[0].detach()
        assert (torch.cdist(starts, real).min(1).values < 1e-3).all()


def make_agent() -> CQL:
    torch.manual_seed(0)
    options = replace(make_imagination().options, value_gradient=replace(OPTIONS, updates=60, learning_rate=0.01))
    agent = CQL(3, 1, PolicyOptions(hidden=(16, 16), updates=60, warm_start=0, discount=0.9, imagination=options))
    agent.generator, agent.update_index = torch.Generator().manual_seed(0), 0
    agent.imagination = make_imagination()
    optimizers = agent.configure_optimizers()
    agent.optimizers = lambda *_: optimizers  # pyright: ignore[reportAttributeAccessIssue]
    agent.manual_backward = lambda loss: loss.backward()  # pyright: ignore[reportAttributeAccessIssue]
    return agent


def test_the_actor_climbs_and_leaves_the_critics_alone(monkeypatch):
    """More action is more reward in this world, so the mean action rises towards its limit."""
    agent = make_agent()
    monkeypatch.setattr(agent, "clip_gradients", lambda *_, **__: None)
    critics = copy.deepcopy(agent.critics.state_dict())
    data = linear_data((30, 40))
    batch = dict(
        observations=torch.as_tensor(data.observations),
        actions=torch.zeros(len(data), 1),
        rewards=torch.as_tensor(data.rewards),
        returns=torch.as_tensor(data.rewards),
    )
    before = float(agent.actor.act(batch["observations"], deterministic=True).mean())
    for _ in range(60):
        agent.update(batch)
        agent.update_index += 1
    after = float(agent.average_actor.act(batch["observations"], deterministic=True).mean())
    assert after > before + 0.3
    assert all(torch.equal(value, critics[name]) for name, value in agent.critics.state_dict().items())


@pytest.mark.parametrize(
    ("value_gradient", "words"),
    [({"horizon": 2}, ["horizon is 2", "history is 4"]), ({"updates": 4_000}, ["updates is 4000", "3000 updates"])],
)
def test_contradicting_options_are_named(value_gradient, words):
    with pytest.raises(UserError) as error:
        build_params({"train_policy": {"et_cql": {"imagination": {"value_gradient": value_gradient}}}})
    assert all(word in str(error.value) for word in words)
