"""How agents are updated: phases in order, optimisers by name, learning rates, and where imagined rows come in."""

import copy
import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from envtf_lit.agents.agent import Agent
from envtf_lit.agents.bc import BC
from envtf_lit.agents.combo import COMBO
from envtf_lit.agents.cql import CQL
from envtf_lit.agents.et_cql import ETCQL, ETCQLPaper, GuardedRolloutOptions
from envtf_lit.agents.phases import Losses
from envtf_lit.agents.sac import SAC
from envtf_lit.agents.scales import LogReturns
from envtf_lit.agents.value_gradient import ValueGradientOptions
from envtf_lit.agents.warm_start import LEARNING_RATE as WARM_RATE
from envtf_lit.errors import UserError
from envtf_lit.training import Guard
from tests.hand_driven import SHORT, B, flat, hand_driven, imagined_batches, imagining, make_batch

IMAGINING = [(COMBO, {}), (ETCQLPaper, {}), (ETCQL, {"value_gradient": SHORT})]


def weights(agent: Agent) -> dict[str, torch.Tensor]:
    """Each part's own, in a row."""
    return {name: flat(copy.deepcopy(part.module.state_dict())) for name, part in agent.parts().items()}


def et_cql(warm: int, gradient: int) -> Any:
    """Ten updates: `warm`, the losses', and the last `gradient` by the value gradient."""
    options = ValueGradientOptions(updates=gradient, rollouts=4, horizon=2)
    rollouts = GuardedRolloutOptions(history=2)
    return imagining(ETCQL, updates=10, critic_updates=10 - warm - gradient, value_gradient=options, rollouts=rollouts)


def visits(agent: Agent, updates: int) -> list[tuple[str, int]]:
    """The phases that updates fall into, each with how many it had before."""
    seen = list[tuple[str, int]]()
    for phase in agent.phases:
        name = type(phase).__name__
        phase.update = lambda agent, batch, done, name=name: seen.append((name, done)) or {}
    for _ in range(updates):
        agent.update(make_batch())
        agent.update_index += 1
    return seen


@pytest.mark.parametrize(("warm", "gradient"), [(2, 3), (0, 3), (7, 3), (0, 10)])
def test_each_phase_counts_its_own_updates(warm, gradient):
    lengths = {"WatchedWarmStart": warm, "Losses": 10 - warm - gradient, "ValueGradient": gradient}
    expected = [(name, done) for name, length in lengths.items() for done in range(length)]
    agent = et_cql(warm, gradient)
    assert sum(phase.updates for phase in agent.phases) == 10
    assert visits(agent, 10) == expected


@pytest.mark.parametrize(("warm_start", "last"), [(0.5, ("Losses", 4)), (0.99, ("WarmStart", 9))])
def test_updates_beyond_the_planned_ones_are_as_the_last_of_them(warm_start, last):
    agent = hand_driven(CQL, updates=10, warm_start=warm_start)
    assert visits(agent, 13)[9:] == [last] * 4


def test_updates_see_real_rows_in_units_of_the_return_scale():
    agent, batch, seen = hand_driven(CQL), make_batch(), []
    del batch["real"]
    agent.phases[1].update = lambda agent, batch, done: seen.append(batch) or {}
    agent.return_scale.fill_(4.0)
    agent.update(batch)
    for name in ("rewards", "returns"):
        torch.testing.assert_close(seen[0][name], batch[name] / 4.0)
    assert seen[0]["real"].tolist() == [1.0] * B
    assert torch.equal(seen[0]["observations"], batch["observations"])


@pytest.mark.parametrize("clones", [True, False])
def test_what_follows_slowly_catches_up_at_the_end_of_the_warm_start(clones):
    """And an actor that began from another does not clone the log."""
    agent = hand_driven(CQL, updates=10, warm_start=0.5)
    agent.clones, before = clones, weights(agent)
    for done in range(5):
        assert torch.equal(flat(agent.average_actor.state_dict()), before["actor"])
        assert (done == 0) is torch.equal(flat(agent.target_critics.state_dict()), flat(agent.critics.state_dict()))
        logs = agent.update(make_batch())
        assert ("clone_loss" in logs) is clones
        agent.update_index += 1
    after = weights(agent)
    assert torch.equal(flat(agent.target_critics.state_dict()), after["critics"])
    assert torch.equal(flat(agent.average_actor.state_dict()), after["actor"])
    assert {name for name in after if not torch.equal(after[name], before[name])} == {"critics"} | (
        {"actor"} if clones else set()
    )


# optimisers


@pytest.mark.parametrize("part", ["actor", "critics", "temperature"])
def test_an_optimiser_steps_the_part_of_its_name_alone(part):
    agent = hand_driven(CQL)
    before = weights(agent)
    for module in (part.module for part in agent.parts().values()):
        flat(dict(module.named_parameters())).square().sum().backward()
    agent.optimizer(part).step()
    after = weights(agent)
    assert [name for name in after if not torch.equal(after[name], before[name])] == [part]


def test_a_single_part_has_its_optimiser_too():
    agent = hand_driven(BC)
    assert [*agent.parts()] == ["actor"] and agent.optimizer("actor") is agent.optimizers()


def test_descending_takes_the_rate_and_the_clip_that_are_wanted():
    agent = hand_driven(CQL)
    weight = agent.actor.net[0].weight
    before = weight.detach().clone()
    agent.descend("actor", weight.sum(), rate=0.5)
    torch.testing.assert_close(weight.detach(), before - 0.5)  # Adam's first step is its rate
    agent.descend("actor", weight.sum(), clip=2.0)
    assert weight.grad is not None and float(weight.grad.norm()) == pytest.approx(2.0)
    assert agent.optimizer("actor").param_groups[0]["lr"] == 0.5  # kept until another is given


@pytest.mark.parametrize(("schedule", "fall"), [("cosine", 1.0), ("constant", 0.0)])
def test_learning_rates_follow_the_losses_schedule(schedule, fall):
    agent = hand_driven(CQL, updates=10, warm_start=0.2, actor_schedule=schedule)
    rates: dict[str, list[float]] = {"actor": [], "critics": [], "temperature": []}
    for _ in range(10):
        agent.update(make_batch())
        agent.update_index += 1
        for part, seen in rates.items():
            seen.append(agent.optimizer(part).param_groups[0]["lr"])
    peak, steps = agent.options.actor_learning_rate, range(8)
    cosine = [peak * (1 - fall * (0.5 - 0.5 * math.cos(math.pi * done / 8))) for done in steps]
    assert rates["actor"] == pytest.approx([WARM_RATE] * 2 + cosine)
    assert rates["critics"] == pytest.approx([WARM_RATE] * 2 + [agent.options.critic_learning_rate] * len(steps))
    assert rates["temperature"] == pytest.approx([peak] * 10)


def test_a_schedule_may_be_longer_than_its_losses():
    agent, progress = hand_driven(CQL), []
    agent.rate = lambda part, done: progress.append((part, done)) or 0.0
    Losses(5, scheduled=10).update(agent, make_batch(), 4)
    Losses(5).update(agent, make_batch(), 4)
    assert progress == [(part, done) for done in (0.4, 0.8) for part in ("critics", "actor", "temperature")]


# with and without imagination


@pytest.mark.parametrize(("cls", "options"), IMAGINING)
def test_what_imagines_needs_imagined_rows(cls, options):
    assert imagining(cls, **options).source is not None
    with pytest.raises(UserError, match=r"imagines and has no source of imagined rows: give it one, source="):
        hand_driven(cls, **options)


@pytest.mark.parametrize("cls", [BC, SAC, CQL])
def test_what_learns_from_data_alone_takes_none(cls):
    with pytest.raises(UserError, match=r"learns from data alone and is given a source of imagined rows: leave it out"):
        hand_driven(cls, source=imagined_batches())


def test_imagined_rows_enter_the_losses_alone():
    """The warm start sees real rows; the losses a mixture, mixed under the actor that learns, from their first on."""
    agent, mixed = et_cql(2, 6), []
    original = agent.source.mix
    agent.source.mix = lambda *given: mixed.append(given[1:]) or original(*given)
    for _ in range(4):
        agent.update(make_batch())
        agent.update_index += 1
    assert mixed == [(done, agent.actor, agent.generator) for done in range(2)]


# divergence


def after_an_epoch(agent: Any, **means: float) -> None:
    """What an agent's own hook logs, and the guard that every training has behind it."""
    agent.effective_episodes, agent.logged = 5.0, {name: [torch.tensor(value)] for name, value in means.items()}
    metrics: dict[str, torch.Tensor] = {}
    agent.log_dict = metrics.update
    agent.on_train_epoch_end()
    trainer: Any = SimpleNamespace(callback_metrics=metrics, current_epoch=0)
    Guard().on_train_epoch_end(trainer, agent)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["clone_loss", "q_data"])
def test_what_is_not_finite_stops_a_run(name, value):
    with pytest.raises(UserError, match=f"CQL diverged in epoch 1: train/{name} is {value}, .* raise cql_weight"):
        after_an_epoch(hand_driven(CQL), **{"q_target": 1.0, name: value})


@pytest.mark.parametrize("name", ["q_data", "q_target", "q_policy"])
def test_values_beyond_what_rewards_allow_stop_a_run(name):
    agent = hand_driven(SAC)
    agent.log_returns = LogReturns(largest=3.0 / (1.0 - 0.99))  # rewards of at most three
    agent.return_scale.fill_(100.0)
    after_an_epoch(agent, **{name: 6.9})  # twice that, and what a network says that has learned nothing
    after_an_epoch(agent, **{name: -1e6}, conservative_gap=1e6)
    with pytest.raises(UserError, match=rf"train/{name} is 7\.1, where rewards allow 3 .* lower critic_learning_rate"):
        after_an_epoch(agent, **{name: 7.1})


def test_the_value_gradient_has_cures_of_its_own():
    with pytest.raises(UserError, match=r"train/imagined_value is nan.* lower value_gradient\.learning_rate"):
        after_an_epoch(et_cql(2, 3), imagined_value=float("nan"))
