"""Agents on a problem whose optimum is known: one step, reward `1 - (a - s_0 / 2)^2`, a log of random actions.

The best action earns one in every state; the log's mean action earns 0.67, its actions 0.33. An agent that follows the
recorded values, not the recorded actions, comes within five hundredths of the optimum.
"""

from typing import Any

import pytest
import torch
from torch import Tensor

from envtf_lit.agents.bc import BC
from envtf_lit.agents.cql import CQL
from envtf_lit.agents.iql import IQL
from envtf_lit.agents.rebrac import ReBRAC
from envtf_lit.agents.sac import SAC
from envtf_lit.agents.td3_bc import TD3BC
from envtf_lit.agents.wbc import WBC
from tests.hand_driven import S, hand_driven

ROWS = 128


def earned(observations: Tensor, actions: Tensor) -> Tensor:
    return 1.0 - (actions[:, 0] - 0.5 * observations[:, 0]).square()


def log_rows(generator: torch.Generator) -> dict[str, Tensor]:
    """One step each, after which the task has terminated."""
    observations = 4.0 * torch.rand(ROWS, S, generator=generator) - 2.0
    actions = 2.0 * torch.rand(ROWS, 1, generator=generator) - 1.0
    rewards = earned(observations, actions)
    return dict(
        observations=observations,
        actions=actions,
        rewards=rewards,
        next_observations=observations,
        discounts=torch.zeros(ROWS),
        returns=rewards,
        next_actions=actions,
        followed=torch.zeros(ROWS),
        following_observations=observations,
        last_observations=observations,
        tails=torch.zeros(ROWS),
    )


def trained_reward(cls: Any, updates: int, **options: Any) -> float:
    """What the averaged actor earns after so many updates."""
    rates: dict[str, Any] = dict(
        actor_learning_rate=0.01, critic_learning_rate=0.01, actor_schedule="constant", actor_average=0.05
    )
    agent = hand_driven(cls, action_dim=1, hidden=(32, 32), **rates | options)
    generator = torch.Generator().manual_seed(0)
    for _ in range(updates):
        agent.update(log_rows(generator))
        agent.update_index += 1
    states = 4.0 * torch.rand(2_000, S, generator=generator) - 2.0
    return float(earned(states, agent.average_actor.act(states)).mean())


@pytest.mark.parametrize(
    ("cls", "options"),
    [
        (WBC, {"beta": 5.0}),
        (TD3BC, {}),
        (ReBRAC, {}),
        (IQL, {"beta": 10.0, "target_rate": 0.1}),
        pytest.param(SAC, {"clone_weight": 0.0}, marks=pytest.mark.slow),
        pytest.param(CQL, {"clone_weight": 0.0}, marks=pytest.mark.slow),
    ],
    ids=lambda x: x.__name__ if isinstance(x, type) else "",
)
def test_an_agent_comes_within_five_hundredths_of_the_optimum(cls: Any, options: dict[str, Any]) -> None:
    assert trained_reward(cls, 200, **options) > 0.95


def test_cloning_earns_what_the_logs_mean_action_does() -> None:
    """Which is no more than 0.67: the problem tells methods apart."""
    assert trained_reward(BC, 60) < 0.75
