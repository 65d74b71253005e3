"""Values in bf16: hidden layers may be, but what is summed, compared or ranked keeps the digits that tell it apart."""

from typing import Any

import pytest
import torch
from torch import Tensor

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.agents.cql import CQL
from envtf_lit.agents.networks import StateValue
from envtf_lit.critics import StackedCritics
from envtf_lit.devices import autocast, resolved
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.stage import run_settings
from envtf_lit.world_models.options import TransformerOptions
from tests.hand_driven import B, S, hand_driven, imagination, make_batch

A, PAIRS = 2, 4_096


def bf16() -> torch.autocast:
    return torch.autocast("cpu", dtype=torch.bfloat16)


def pairs() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(PAIRS, S, generator=generator), torch.rand(PAIRS, A, generator=generator) * 2 - 1


def raised(network: StackedCritics | StateValue, level: float) -> None:
    """Values about this level, as different among themselves as before."""
    assert network.out.bias is not None
    with torch.no_grad():
        network.out.bias.add_(level)


def check_spread(exact: Tensor, found: Tensor) -> None:
    spread = float(exact.detach().double().std())
    error = float((found - exact).detach().double().square().mean().sqrt())
    assert found.dtype == torch.float32 and error < 0.05 * spread
    assert len(found.unique()) > 1_000  # at 3,000 the steps of fp32 itself are a 1,500th of the spread


@pytest.mark.parametrize("level", [300.0, 3_000.0])
def test_values_of_any_size_differ_in_bf16_as_they_do_in_fp32(level):
    torch.manual_seed(0)
    critics, value = StackedCritics(S, A, hidden=(64, 64), layer_norm=True), StateValue(S, hidden=(64, 64))
    raised(critics, level)
    raised(value, level)
    observation, action = pairs()
    exact, exact_value = critics(observation, action), value(observation)
    with bf16():
        found, found_value = critics(observation, action), value(observation)
    for one in range(2):
        check_spread(exact[one], found[one])
    check_spread(exact_value, found_value)


def test_actions_and_their_densities_are_in_fp32():
    """Of an actor that is narrow, and away from zero, where steps of bf16 are as wide as its spread."""
    torch.manual_seed(0)
    actor, (observation, _) = TanhGaussianActor(S, A, hidden=(64, 64)), pairs()
    last: Any = actor.net[-1]
    last.bias.data.copy_(torch.tensor([2.0, 2.0, -4.0, -4.0]))
    with torch.no_grad():
        last.weight.mul_(0.1)
        action, _ = actor.sample(observation, generator=torch.Generator().manual_seed(0))
        exact = actor.log_prob(observation, action)
        with bf16():
            found, (sampled, density) = actor.log_prob(observation, action), actor.sample(observation)
    check_spread(exact, found)
    assert sampled.dtype == density.dtype == torch.float32


def test_targets_and_the_conservative_term_are_in_fp32():
    agent, batch = hand_driven(CQL, action_dim=A, sampled_actions=50), make_batch(A)
    raised(agent.critics, 3_000.0)
    raised(agent.target_critics, 3_000.0)
    with torch.no_grad():
        actions, density = agent.proposals(batch)
        exact = agent.pushed_down(agent.critics(batch["observations"], actions), density)
        agent.generator.manual_seed(0)
        exact_target = agent.td_target(batch)
        with bf16():
            pushed = agent.pushed_down(agent.critics(batch["observations"], actions), density)
            agent.generator.manual_seed(0)
            target = agent.td_target(batch)
    assert pushed.dtype == target.dtype == torch.float32 and len(target.unique()) == B
    torch.testing.assert_close(pushed, exact, atol=0.02, rtol=0)
    torch.testing.assert_close(target, exact_target, atol=0.02, rtol=0)


def test_imagination_is_in_fp32():
    """The noise of bf16 would pass for novelty, and for epistemic variance."""
    torch.manual_seed(0)
    actor, imagined = TanhGaussianActor(S, 1, hidden=(16,)), imagination(branches=50, value_expansion=3)
    exact = imagined.rollouts(actor, torch.Generator().manual_seed(0))
    with bf16():
        found = imagined.rollouts(actor, torch.Generator().manual_seed(0))
    assert torch.equal(found.next_observations, exact.next_observations)


# which precision


@pytest.mark.parametrize(
    ("able", "expected"), [({}, "fp32"), ({"avx512_bf16": True}, "bf16"), ({"amx_bf16": True}, "bf16")]
)
def test_auto_is_bf16_where_the_processor_multiplies_it(monkeypatch, able, expected) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: able)
    cpu = torch.device("cpu")
    assert resolved("auto", cpu) == expected
    assert (resolved("fp32", cpu), resolved("bf16", cpu)) == ("fp32", "bf16")
    with autocast(cpu, "auto"):
        assert torch.is_autocast_enabled("cpu") is (expected == "bf16")


def test_what_auto_was_stands_in_a_runs_record(monkeypatch) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", dict)
    assert run_settings(Params(), TransformerOptions())["precision"] == "fp32"
