"""Implicit Q-learning by hand: the expectile, the cut weights, targets without actions, and published rewards."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from envtf_lit.agents.iql import IQL, expectile_loss
from envtf_lit.data.datamodules import TransitionData
from envtf_lit.data.sources.files import save_dataset
from tests.analytic import linear_data
from tests.hand_driven import B, hand_driven, make_batch

A = 2


class Given(nn.Module):
    """Says one number for each row."""

    def __init__(self, values: Tensor) -> None:
        super().__init__()
        self.values = values

    def forward(self, *_: Tensor) -> Tensor:
        return self.values


def make_agent(**options: Any) -> Any:
    return hand_driven(IQL, action_dim=A, **options)


@pytest.mark.parametrize("expectile", [0.5, 0.7, 0.9])
def test_the_expectile_of_a_fair_zero_or_one_is_itself(expectile: float) -> None:
    """It solves `tau (1 - v) = (1 - tau) v`."""
    outcomes, value = torch.tensor([0.0, 1.0]), torch.zeros((), requires_grad=True)
    optimizer = torch.optim.SGD([value], lr=0.5)
    for _ in range(200):
        optimizer.zero_grad()
        expectile_loss(outcomes - value, expectile).mean().backward()
        optimizer.step()
    assert float(value.detach()) == pytest.approx(expectile, abs=1e-5)


def test_the_value_loss_is_the_expectile_of_the_smaller_target_critic() -> None:
    agent, batch = make_agent(expectile=0.7), make_batch(A)
    value = agent.value(batch["observations"])
    q = torch.tensor([2.0, -2.0] * (B // 2))
    expected = (torch.where(q < value, 0.3, 0.7) * (q - value).square()).mean()
    torch.testing.assert_close(agent.value_loss(batch, q)[0], expected)


def test_critics_regress_on_the_value_of_the_next_state() -> None:
    agent, batch = make_agent(), make_batch(A)
    target = batch["rewards"] + 0.99 * agent.value(batch["next_observations"]).detach()
    q = agent.critics(batch["observations"], batch["actions"])
    torch.testing.assert_close(agent.critic_loss(batch)[0], sum((one - target).square().mean() for one in q))


def test_weights_of_imitation_are_cut_at_a_hundred() -> None:
    agent, batch = make_agent(beta=3.0), make_batch(A)
    advantage = torch.tensor([-1.0, 0.0, 0.5, 1.0, 1.5, 2.0, 10.0, 1e6])
    agent.value = Given(torch.zeros(B))
    weight = torch.tensor([min(100.0, float(np.exp(min(3.0 * x, 50.0)))) for x in advantage.tolist()])
    log_density = agent.actor.log_prob(batch["observations"], batch["actions"])
    loss, logs = agent.actor_loss(batch, advantage)
    torch.testing.assert_close(loss, -(weight * log_density).mean())
    torch.testing.assert_close(logs["weight"], weight.mean())


def test_each_loss_reaches_its_own_part_alone() -> None:
    agent, seen = make_agent(), []
    for part, loss, _ in agent.losses(make_batch(A)):
        agent.zero_grad(set_to_none=True)
        loss.backward()
        reached = {name for name, weight in agent.named_parameters() if weight.grad is not None}
        assert reached == {name for name, _ in agent.named_parameters() if name.startswith(f"{part}.")}
        seen.append(part)
    assert seen == ["value", "actor", "critics"]


def test_the_actors_rate_falls_along_half_a_cosine() -> None:
    agent = make_agent(actor_learning_rate=1.0, actor_schedule="cosine")
    assert [agent.rate("actor", p) for p in (0.0, 0.5, 1.0)] == pytest.approx([1.0, 0.5, 0.0])
    assert agent.rate("value", 0.5) == agent.options.critic_learning_rate


def test_published_rewards_make_the_logs_returns_span_a_thousand(tmp_path: Path) -> None:
    save_dataset(linear_data((10, 20, 30)), tmp_path / "log.h5")
    agent, data = make_agent(return_range=1_000.0), TransitionData(str(tmp_path / "log.h5"))
    agent.trainer = SimpleNamespace(datamodule=data)
    agent.setup("fit")
    assert np.ptp(data.dataset.episode_returns) / float(agent.return_scale) == pytest.approx(1_000.0)


def test_the_warm_start_teaches_value_critics_and_actor_what_the_log_says() -> None:
    agent, batch = make_agent(warm_start=1.0), make_batch(A)
    first = agent.update(batch)
    for _ in range(40):
        last = agent.update(batch)
    assert {"warm_value_loss", "warm_critic_loss", "clone_loss"} <= last.keys()
    assert all(last[name] < first[name] for name in ("warm_value_loss", "warm_critic_loss", "clone_loss"))
