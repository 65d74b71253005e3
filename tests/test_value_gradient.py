"""The gradient of imagined returns: paths, their value by hand, and an actor that improves in a world known exactly."""

import copy
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from envtf_lit.agents import value_gradient
from envtf_lit.agents.et_cql import ETCQL
from envtf_lit.agents.scales import LogReturns
from envtf_lit.agents.value_gradient import (
    BETAS,
    LOST,
    ImaginedPaths,
    Paths,
    StateValues,
    ValueGradient,
    ValueGradientOptions,
)
from envtf_lit.errors import UserError
from envtf_lit.imagination.options import RolloutOptions
from envtf_lit.imagination.rollouts import Rollouts
from envtf_lit.pipeline.params import build_params
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.interface import Prediction
from envtf_lit.world_models.transformer import EnvironmentTransformer
from tests.analytic import LinearWorld, linear_data, linear_world
from tests.hand_driven import EPISODES, flat, hand_driven, imagination, imagined_batches, made_rollouts

OPTIONS = ValueGradientOptions(updates=4, rollouts=6, horizon=3)
ONE = torch.ones(())
SPREAD = 2.0


class Constant(nn.Module):
    """An actor that always takes the same action, and a state value that is the same everywhere."""

    def __init__(self, value: float) -> None:
        super().__init__()
        self.level = nn.Parameter(torch.tensor(value))

    def sample(self, observation: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        return self.level.expand(len(observation), 1), torch.zeros(len(observation))

    def forward(self, observation: Tensor) -> Tensor:
        return self.level.expand(observation.shape[:-1])


def make_values(value: float) -> StateValues:
    values = StateValues(3)
    values.value = values.target_value = Constant(value)  # pyright: ignore[reportAttributeAccessIssue]
    return values


def hand_made(last_reward: float = 3.0) -> Paths:
    """Two rollouts of three steps, neither of which leaves; the second falls at its second step."""
    paths = made_rollouts([[1.0, 1.0], [2.0, 2.0], [3.0, last_reward]])
    paths.terminated[1, 1] = True
    return Paths(**vars(paths), excess=torch.zeros(3, 2))


def test_a_paths_return_ends_with_the_fall_and_else_with_the_states_value():
    returns = make_values(10.0).imagined_return(hand_made(), 0.5, SPREAD)
    torch.testing.assert_close(returns, torch.tensor([1.0 + 1.0 + 0.75 + 0.125 * 10.0, 1.0 + 1.0]))


def test_where_the_model_is_lost_a_path_ends_at_the_last_known_states_value_less_its_cost():
    """The prediction itself counts for nothing, whatever it promises; the other path falls at the same step."""
    paths, worth = hand_made(), 10.0 - LOST * SPREAD * 0.3
    paths.rewards[1, 0], paths.halted[1, 0], paths.excess[1, 0] = 1e6, True, 0.3
    paths.halted[2], paths.excess[2] = True, 9.0  # after both have ended
    returns = make_values(10.0).imagined_return(paths, 0.5, SPREAD)
    torch.testing.assert_close(returns, torch.tensor([1.0 + 0.5 * worth, 1.0 + 1.0]))
    targets = make_values(10.0).value_targets(paths, 0.5, SPREAD)
    first = 1.0 + 0.5 * (0.05 * 10.0 + 0.95 * worth)
    torch.testing.assert_close(targets[:2, 0], torch.tensor([first, worth]))
    states = torch.cat([s for s, _ in make_values(0.0).value_batches(paths, 0.5, SPREAD, torch.Generator())])
    assert set(states[:, 0].tolist()) == {0.0, 1.0, 10.0, 11.0}


@pytest.mark.parametrize("trace", [0.0, 0.5, 1.0])
def test_value_targets_are_td_lambda(trace, monkeypatch):
    monkeypatch.setattr(value_gradient, "TRACE", trace)
    targets = make_values(10.0).value_targets(hand_made(), 0.5, SPREAD)
    last = 3.0 + 0.5 * 10.0
    middle = 2.0 + 0.5 * ((1 - trace) * 10.0 + trace * last)
    first = 1.0 + 0.5 * ((1 - trace) * 10.0 + trace * middle)
    torch.testing.assert_close(targets[:, 0], torch.tensor([first, middle, last]))
    torch.testing.assert_close(targets[:2, 1], torch.tensor([1.0 + 0.5 * ((1 - trace) * 10.0 + trace * 2.0), 2.0]))


def test_the_value_learns_nothing_from_steps_after_a_fall(monkeypatch):
    monkeypatch.setattr(value_gradient, "PASSES", 3)
    batches = list(make_values(10.0).value_batches(hand_made(1e6), 0.5, SPREAD, torch.Generator().manual_seed(0)))
    assert sum(len(states) for states, _ in batches) == 3 * 5
    assert max(float(targets.max()) for _, targets in batches) < 100.0


def test_every_pass_pairs_each_state_with_its_target(monkeypatch):
    monkeypatch.setattr(value_gradient, "BATCH", 2)
    values, paths = make_values(10.0), hand_made()
    targets = values.value_targets(paths, 0.5, SPREAD)
    expected = {(float(paths.observations[t, b, 0]), float(targets[t, b])) for t in range(3) for b in range(2)}
    expected.discard((12.0, float(targets[2, 1])))  # after the fall
    batches = list(values.value_batches(paths, 0.5, SPREAD, torch.Generator().manual_seed(0)))
    assert {len(states) for states, _ in batches} == {1, 2}
    pairs = [(float(s[0]), float(g)) for states, goals in batches for s, g in zip(states, goals, strict=True)]
    assert set(pairs) == expected and len(pairs) == value_gradient.PASSES * 5


def test_the_gradient_through_the_world_equals_finite_differences():
    def value(level: float) -> tuple[Tensor, Constant]:
        actor: Any = Constant(level)
        paths = ImaginedPaths(imagination(), OPTIONS).next(actor, ONE, torch.Generator().manual_seed(0))
        return make_values(2.0).imagined_return(paths, 0.9, SPREAD).mean(), actor

    middle, actor = value(0.3)
    middle.backward()
    slope = ((value(0.4)[0] - value(0.2)[0]) / 0.2).detach()
    assert actor.level.grad is not None and abs(float(slope)) > 0.01
    torch.testing.assert_close(actor.level.grad, slope, rtol=1e-3, atol=1e-5)


def test_rewards_of_paths_are_divided_by_the_scale():
    def rewards(scale: float) -> Tensor:
        actor: Any = Constant(0.1)
        paths = ImaginedPaths(imagination(), OPTIONS).next(actor, torch.tensor(scale), torch.Generator().manual_seed(0))
        return paths.rewards

    torch.testing.assert_close(rewards(4.0), rewards(1.0) / 4.0)


def test_rollouts_go_on_where_they_stood_until_they_are_old(monkeypatch):
    monkeypatch.setattr(value_gradient, "OLDEST", 6)
    paths, generator = ImaginedPaths(imagination(), OPTIONS), torch.Generator().manual_seed(0)
    actor: Any = Constant(0.1)
    first, second, third = (paths.next(actor, ONE, generator) for _ in range(3))
    torch.testing.assert_close(second.observations[0], first.next_observations[-1])
    assert not torch.isclose(third.observations[0], second.next_observations[-1]).all(-1).any()


def test_uncertainty_costs_a_path_what_it_costs_a_rollout():
    def rewards(penalty: float) -> Tensor:
        actor: Any = Constant(0.1)
        imagined = imagination(penalty=penalty)
        imagined.reward_std = 3.0
        return ImaginedPaths(imagined, OPTIONS).next(actor, torch.tensor(2.0), torch.Generator().manual_seed(0)).rewards

    torch.testing.assert_close(rewards(0.0) - rewards(4.0), torch.full((3, 6), 4.0 * 3.0 * 0.1 / 2.0))


@dataclass
class Known(LinearWorld):
    """Knows actions up to a half; what it is unsure of, it says, and rewards lie beyond."""

    def step(self, state: Tensor, action: Tensor, **options: Any) -> tuple[Tensor, Prediction]:
        following, found = super().step(state, action, **options)
        unsure = (action[:, 0].abs() - 0.5).clamp(min=0.0)
        reward = found.reward + 100.0 * action[:, 0]
        return following, replace(found, reward=reward, uncertainty=found.uncertainty + unsure, novelty=0.5 + unsure)


def improved(penalty: float, limit: float | None) -> tuple[float, float]:
    """The mean action, and the share of paths that are cut, after some updates in a world that promises riches."""
    agent, batch = make_agent(penalty=penalty, novelty_limit=limit), log_batch()
    agent.source.imagination.model = Known(**vars(linear_world()))
    agent.source.imagination.reward_std = 1.0
    agent.log_returns = LogReturns(spread=58.0 / (1.0 - 0.9**2) ** 0.5)  # of such rewards, under random actions
    for _ in range(40):
        found = agent.update(batch)
        agent.update_index += 1
    return float(agent.average_actor.act(batch["observations"]).mean()), float(found["cut_share"])


def test_guards_hold_the_policy_where_the_model_knows_its_way():
    free, uncut = improved(0.0, None)
    assert free > 0.6 and uncut == 0.0
    assert improved(1_000.0, None)[0] < 0.5  # the penalty's gradient points back
    held, cut = improved(0.0, 0.5)  # beyond, no promise counts, and what led there is held back
    assert held < free - 0.1 and cut > 0.0


@pytest.mark.parametrize("kind", ["transformer", "ensemble"])
def test_a_rollout_stays_in_its_world_until_it_begins_anew(kind, monkeypatch):
    monkeypatch.setattr(value_gradient, "OLDEST", 9)
    imagined = imagination(posterior=1.0)
    torch.manual_seed(0)
    if kind == "transformer":
        model: Any = EnvironmentTransformer(3, 1, layers=1, heads=1, width=8, context=4)
    else:
        model = EnsembleDynamics(3, 1, members=60, elites=50, hidden=(4, 4))
    imagined.model = model.requires_grad_(False)
    paths, generator, worlds = ImaginedPaths(imagined, OPTIONS), torch.Generator().manual_seed(0), []
    actor: Any = Constant(0.1)
    for _ in range(4):
        paths.next(actor, ONE, generator)
        worlds.append(paths.former.drawn.clone())
    assert torch.equal(worlds[0], worlds[1]) and torch.equal(worlds[0], worlds[2])
    assert not torch.equal(worlds[2], worlds[3])  # too old
    paths.histories = None
    paths.next(actor, ONE, generator)
    assert not torch.equal(paths.former.drawn, worlds[3])


def begins_at_real_states(paths: Rollouts) -> bool:
    real = torch.as_tensor(linear_data(EPISODES).observations)
    return bool((torch.cdist(paths.observations[0].detach(), real).min(1).values < 1e-3).all())


def test_the_fallen_begin_anew_at_real_states():
    paths, generator = ImaginedPaths(imagination(-1e9), OPTIONS), torch.Generator().manual_seed(0)  # all fall at once
    actor: Any = Constant(0.1)
    for _ in range(2):
        found = paths.next(actor, ONE, generator)
        assert found.terminated.all() and found.valid.all()  # no rollout leaves
        assert not value_gradient.standing(found)[0][1:].any()
        assert begins_at_real_states(found)


def test_the_lost_begin_anew_at_real_states():
    lost = imagination(novelty_limit=1.0)
    lost.model = linear_world(novelty=torch.full((6,), 2.0))
    paths, generator = ImaginedPaths(lost, OPTIONS), torch.Generator().manual_seed(0)
    actor: Any = Constant(0.1)
    for _ in range(2):
        found = paths.next(actor, ONE, generator)
        assert found.halted.all() and not value_gradient.standing(found)[1].any()
        assert begins_at_real_states(found)


def test_rollouts_under_way_do_not_outlive_an_epoch():
    phase, generator = ValueGradient(imagination(), make_values(0.0), OPTIONS), torch.Generator().manual_seed(0)
    actor: Any = Constant(1.0)
    for begun, real in ((False, True), (False, False), (True, True)):
        if begun:
            phase.begin_epoch(None)  # pyright: ignore[reportArgumentType]
        assert begins_at_real_states(phase.paths.next(actor, ONE, generator)) is real


def test_the_learning_rate_rises_over_a_tenth_and_falls_to_zero():
    phase = ValueGradient(imagination(), make_values(0.0), replace(OPTIONS, learning_rate=0.9))
    progress = [0.0, 0.05, 0.1, 0.55, 1.0]
    assert [phase.rate(x) for x in progress] == pytest.approx([0.0, 0.45, 0.9, 0.45, 0.0])


def make_agent(**rollouts: Any) -> Any:
    options = replace(OPTIONS, updates=60, learning_rate=0.01)
    plain = RolloutOptions(history=2)
    source = imagined_batches(**rollouts)
    return hand_driven(ETCQL, source=source, discount=0.9, rollouts=plain, value_gradient=options)


def log_batch() -> dict[str, Tensor]:
    data = linear_data(EPISODES)
    return dict(
        observations=torch.as_tensor(data.observations),
        actions=torch.zeros(len(data), 1),
        rewards=torch.as_tensor(data.rewards),
        returns=torch.as_tensor(data.rewards),
        tails=torch.zeros(len(data)),
        last_observations=torch.as_tensor(data.next_observations),
    )


def test_the_actor_improves_and_leaves_the_critics_alone():
    """More action is more reward in this world, so the mean action rises towards its limit."""
    agent, batch = make_agent(), log_batch()
    critics = copy.deepcopy(agent.critics.state_dict())
    before = float(agent.actor.act(batch["observations"], deterministic=True).mean())
    for _ in range(60):
        agent.update(batch)
        agent.update_index += 1
    after = float(agent.average_actor.act(batch["observations"], deterministic=True).mean())
    assert after > before + 0.3
    assert all(torch.equal(value, critics[name]) for name, value in agent.critics.state_dict().items())


def test_the_value_gradient_begins_at_the_averaged_actor_with_an_adam_of_its_own():
    agent = make_agent()
    average = flat(copy.deepcopy(agent.average_actor.state_dict()))
    nn.init.ones_(agent.actor.net[0].weight)
    agent.update(log_batch())  # at a rate of zero
    assert torch.equal(flat(agent.actor.state_dict()), average)
    assert agent.optimizer("actor_by_gradient").param_groups[0]["betas"] == BETAS
    assert agent.optimizer("actor").param_groups[0]["betas"] == (0.9, 0.999)


def test_the_warm_start_fits_the_state_value_to_the_logs_returns():
    options = RolloutOptions(history=2)
    agent = hand_driven(
        ETCQL, source=imagined_batches(), warm_start=0.5, rollouts=options, value_gradient=replace(OPTIONS, updates=30)
    )
    batch = log_batch()

    def error() -> float:
        return agent.values.value_loss(batch["observations"], batch["returns"]).item()

    before = error()
    for _ in range(30):
        agent.update(batch)
        agent.update_index += 1
    assert error() < 0.2 * before
    assert torch.equal(flat(agent.values.target_value.state_dict()), flat(agent.values.value.state_dict()))


def test_without_a_value_gradient_there_is_no_state_value():
    agent = hand_driven(ETCQL, source=imagined_batches(), value_gradient=None)
    assert [*agent.parts()] == ["actor", "critics", "temperature"] and not hasattr(agent, "values")
    assert len(agent.phases) == 2


@pytest.mark.parametrize(
    ("changed", "words"),
    [({"horizon": 2}, ["horizon is 2", "history is 4"]), ({"updates": 4_000}, ["updates is 4000", "3000 updates"])],
)
def test_contradicting_options_are_named(changed, words):
    section = {"algorithm": "et_cql", "value_gradient": changed}
    bc = {"algorithm": "bc"}
    with pytest.raises(UserError, match=r"^train_policy\.mine\.") as error:
        build_params({"train_policy": {"bc": bc, "mine": section}})
    assert all(word in str(error.value) for word in words)
