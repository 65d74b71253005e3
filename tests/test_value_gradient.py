"""The gradient of imagined returns: paths, their value by hand, and an actor that improves in a world known exactly."""

import copy
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from envtf_lit.agents import value_gradient
from envtf_lit.agents.et_cql import ETCQL, GuardedRolloutOptions
from envtf_lit.agents.scales import LogReturns
from envtf_lit.agents.trust_levels import LEVELS, Level
from envtf_lit.agents.value_gradient import (
    BETAS,
    ImaginedPaths,
    ValueGradient,
    ValueGradientOptions,
    imagined_return,
    lambda_targets,
)
from envtf_lit.errors import UserError
from envtf_lit.imagination.rollouts import Rollouts
from envtf_lit.pipeline.params import build_params
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.interface import Prediction
from envtf_lit.world_models.transformer import EnvironmentTransformer
from tests.analytic import LinearWorld, linear_data, linear_world
from tests.hand_driven import EPISODES, flat, hand_driven, imagination, imagined_batches, made_rollouts

OPTIONS = ValueGradientOptions(updates=4, rollouts=6, horizon=3)
ONE = torch.ones(())
LOW = 4.0  # value of a path that is lost


class Constant(nn.Module):
    """An actor that always takes the same action."""

    def __init__(self, value: float) -> None:
        super().__init__()
        self.level = nn.Parameter(torch.tensor(value))

    def sample(self, observation: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        return self.level.expand(len(observation), 1), torch.zeros(len(observation))


def hand_made(last_reward: float = 3.0) -> Rollouts:
    """Two rollouts of three steps, neither of which leaves; the second falls at its second step."""
    paths = made_rollouts([[1.0, 1.0], [2.0, 2.0], [3.0, last_reward]])
    paths.terminated[1, 1] = True
    return paths


def test_a_paths_return_ends_with_the_fall_and_else_with_the_value():
    returns = imagined_return(hand_made(), torch.full((2,), 10.0), LOW, 0.5)
    torch.testing.assert_close(returns, torch.tensor([1.0 + 1.0 + 0.75 + 0.125 * 10.0, 1.0 + 1.0]))


def test_where_the_model_is_lost_a_path_is_worth_little():
    """The prediction itself counts for nothing, whatever it promises; the other path falls at the same step."""
    paths, later = hand_made(), torch.full((3, 2), 10.0)
    paths.rewards[1, 0], paths.halted[1, 0] = 1e6, True
    paths.halted[2] = True  # after both have ended
    returns = imagined_return(paths, later[0], LOW, 0.5)
    torch.testing.assert_close(returns, torch.tensor([1.0 + 0.5 * LOW, 1.0 + 1.0]))
    targets = lambda_targets(paths, later, LOW, 0.5)
    torch.testing.assert_close(targets[:2, 0], torch.tensor([1.0 + 0.5 * (0.05 * 10.0 + 0.95 * LOW), LOW]))


@pytest.mark.parametrize("trace", [0.0, 0.5, 1.0])
def test_value_targets_are_td_lambda(trace, monkeypatch):
    monkeypatch.setattr(value_gradient, "TRACE", trace)
    targets = lambda_targets(hand_made(), torch.full((3, 2), 10.0), LOW, 0.5)
    last = 3.0 + 0.5 * 10.0
    middle = 2.0 + 0.5 * ((1 - trace) * 10.0 + trace * last)
    first = 1.0 + 0.5 * ((1 - trace) * 10.0 + trace * middle)
    torch.testing.assert_close(targets[:, 0], torch.tensor([first, middle, last]))
    torch.testing.assert_close(targets[:2, 1], torch.tensor([1.0 + 0.5 * ((1 - trace) * 10.0 + trace * 2.0), 2.0]))


def test_critics_learn_nothing_from_steps_after_a_fall():
    """Each row pairs a state that a path stood in with its own target, and nothing is bootstrapped again."""
    agent = make_agent()
    agent.target_critics.forward = lambda states, actions: torch.full((2, len(states)), 10.0)
    rows = agent.phases[-1].rows(agent, hand_made(1e6))
    targets = lambda_targets(hand_made(1e6), torch.full((3, 2), 10.0), 0.0, agent.options.discount)
    stood = [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1)]
    expected = {(10.0 * b + t, round(float(targets[t, b]), 4)) for t, b in stood}
    found = zip(rows["observations"][:, 0].tolist(), rows["rewards"].tolist(), strict=True)
    assert {(state, round(target, 4)) for state, target in found} == expected
    assert not rows["discounts"].any() and not rows["real"].any()


def test_the_gradient_through_the_world_equals_finite_differences():
    def value(level: float) -> tuple[Tensor, Constant]:
        actor: Any = Constant(level)
        paths = ImaginedPaths(imagination(), OPTIONS).next(actor, ONE, torch.Generator().manual_seed(0))
        return imagined_return(paths, torch.full((6,), 2.0), LOW, 0.9).mean(), actor

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


@pytest.mark.parametrize("cut_short", [True, False])
def test_rollouts_go_on_where_they_stood_until_they_are_as_old_as_an_episode(cut_short, monkeypatch):
    """As old as the log's time limit, if it has one."""
    imagined = imagination()
    imagined.longest_recorded, imagined.cut_short = (6, True) if cut_short else (1, False)
    monkeypatch.setattr(value_gradient, "OLDEST", 60 if cut_short else 6)
    paths, generator = ImaginedPaths(imagined, OPTIONS), torch.Generator().manual_seed(0)
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
    agent, batch = trusting(make_agent(penalty=penalty, novelty_limit=limit), 20.0), log_batch()
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
def test_a_rollout_stays_in_its_world_until_it_begins_anew(kind):
    imagined = imagination(posterior=1.0)
    imagined.longest_recorded, imagined.cut_short = 9, True
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
    phase, generator = ValueGradient(imagination(), OPTIONS, LEVELS["default"]), torch.Generator().manual_seed(0)
    actor: Any = Constant(1.0)
    for begun, real in ((False, True), (False, False), (True, True)):
        if begun:
            phase.begin_epoch(None)  # pyright: ignore[reportArgumentType]
        assert begins_at_real_states(phase.paths.next(actor, ONE, generator)) is real


def test_the_learning_rate_rises_over_a_tenth_and_falls_over_the_last():
    phase = ValueGradient(imagination(), replace(OPTIONS, learning_rate=0.9), LEVELS["default"])
    progress = [0.0, 0.05, 0.1, 0.55, 0.95, 1.0]
    assert [phase.rate(x) for x in progress] == pytest.approx([0.0, 0.45, 0.9, 0.9, 0.45, 0.0])


def make_agent(**rollouts: Any) -> Any:
    options = replace(OPTIONS, updates=60, learning_rate=0.01)
    plain = GuardedRolloutOptions(history=2)
    source = imagined_batches(**rollouts)
    return hand_driven(
        ETCQL, source=source, discount=0.9, rollouts=plain, value_gradient=options, critic_updates=0, trust="bold"
    )


def log_batch() -> dict[str, Tensor]:
    data = linear_data(EPISODES)
    return dict(
        observations=torch.as_tensor(data.observations),
        actions=torch.zeros(len(data), 1),
        rewards=torch.as_tensor(data.rewards),
        returns=torch.as_tensor(data.rewards),
        tails=torch.zeros(len(data)),
        last_observations=torch.as_tensor(data.next_observations),
        next_observations=torch.as_tensor(data.next_observations),
        following_observations=torch.as_tensor(data.next_observations),
        discounts=torch.zeros(len(data)),
    )


def trusting(agent: Any, slack: float) -> Any:
    """The agent, whose value gradient may leave the log by so many nats; and as if it had cloned it."""
    agent.phases[-1].level = Level(slack, 0.0, believes=True)
    agent.trust.look(agent.actor)
    return agent


def test_the_actor_improves_as_far_as_trust_reaches():
    """More action is more reward in this world, so the mean action rises: by more, the further trust reaches."""

    def rise(slack: float) -> float:
        agent, batch = trusting(make_agent(), slack), log_batch()
        before = float(agent.actor.act(batch["observations"]).mean())
        for _ in range(59):
            agent.update(batch)
            agent.update_index += 1
        return float(agent.average_actor.act(batch["observations"]).mean()) - before

    far, near = rise(20.0), rise(0.01)
    assert far > 0.3 and near < 0.5 * far


def test_critics_learn_from_paths_and_from_real_rows():
    agent, batch, seen = trusting(make_agent(), 1.0), log_batch(), []
    original = agent.critic_loss
    agent.critic_loss = lambda mixed: seen.append(mixed) or original(mixed)
    agent.update(batch)
    assert len(seen) == value_gradient.CRITIC_STEPS
    for mixed in seen:
        assert len(mixed["real"]) == 70 and float(mixed["real"].mean()) == pytest.approx(0.25, abs=0.01)


def test_the_value_gradient_begins_at_the_averaged_actor_with_an_adam_of_its_own():
    agent = make_agent()
    average = flat(copy.deepcopy(agent.average_actor.state_dict()))
    nn.init.ones_(agent.actor.net[0].weight)
    trusting(agent, 1.0).update(log_batch())  # at a rate of zero
    assert torch.equal(flat(agent.actor.state_dict()), average)
    assert agent.optimizer("actor_by_gradient").param_groups[0]["betas"] == BETAS
    assert agent.optimizer("actor").param_groups[0]["betas"] == (0.9, 0.999)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"horizon": 2}, ["horizon is 2", "history is 4"]),
        ({"updates": 4_000}, ["updates is 4000", "critic_updates is 1000", "4500 updates"]),
    ],
)
def test_contradicting_options_are_named(changed, words):
    section = {"algorithm": "et_cql", "value_gradient": changed}
    bc = {"algorithm": "bc"}
    with pytest.raises(UserError, match=r"^train_policy\.mine\.") as error:
        build_params({"train_policy": {"bc": bc, "mine": section}})
    assert all(word in str(error.value) for word in words)


def test_without_a_warm_start_distance_is_from_the_actor_that_it_began_with() -> None:
    agent = make_agent()
    agent.update(log_batch())
    assert torch.equal(flat(agent.trust.clone.state_dict()), flat(agent.frontier.actors[0].state_dict()))
    assert float(agent.frontier.table[0, 1]) == pytest.approx(0.0, abs=1e-6)
