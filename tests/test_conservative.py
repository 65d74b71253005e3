"""What conservative Q-learning is worth: known integrals, the sign of each row's gradient, a small decision process."""

import math
from typing import Any

import pytest
import torch

from envtf_lit.agents.combo import COMBO
from envtf_lit.agents.cql import CQL
from envtf_lit.agents.et_cql import ETCQLPaper
from envtf_lit.agents.sac import SAC
from tests.hand_driven import B, S, hand_driven, imagining, make_batch


@pytest.mark.parametrize("slope", [0.5, 2.0])
@pytest.mark.parametrize("kind", ["uniform", "policy"])
def test_the_log_sum_exp_of_a_linear_q_is_its_integral(slope: float, kind: str) -> None:
    """`log of the integral of exp(w a) over [-1, 1] = log(2 sinh w / w)`."""
    N = 20_000
    agent = hand_driven(CQL, sampled_actions=N)
    actions, log_density = agent.proposals(make_batch())
    part = slice(0, N) if kind == "uniform" else slice(N, 2 * N)
    q = slope * actions[None, :, part, 0].detach()
    found = agent.pushed_down(q, log_density[:, part].detach())
    torch.testing.assert_close(found, torch.full((1, B), math.log(2 * math.sinh(slope) / slope)), atol=0.05, rtol=0.0)


@pytest.mark.parametrize("cls", [COMBO, ETCQLPaper])
def test_combo_pushes_up_real_rows_alone_and_the_paper_all(cls: Any) -> None:
    """The sign of the conservative term's gradient in each row."""
    agent, real = imagining(cls), (torch.arange(B) < 3).float()
    q_data, q_proposed = torch.randn(2, B, requires_grad=True), torch.randn(2, B, 6, requires_grad=True)
    agent.conservative_gap(q_data, q_proposed, torch.zeros(B, 6), real).sum().backward()
    assert q_data.grad is not None and q_proposed.grad is not None
    up = -1.0 / 3 * real if cls is COMBO else torch.full((B,), -1.0 / B)
    torch.testing.assert_close(q_data.grad, up.expand(2, B))
    assert (q_proposed.grad > 0).all()
    torch.testing.assert_close(q_proposed.grad.sum(-1), torch.full((2, B), 1.0 / B))


def learned_value(cls: Any, **options: Any) -> tuple[float, float]:
    """Q of the policy's actions, and of the recorded ones, where each step is worth one and half of it is to come.

    The log has a narrow stretch of actions alone. The true value is two, whatever is done.
    """
    agent = hand_driven(
        cls, action_dim=1, discount=0.5, clone_weight=0.0, critic_learning_rate=0.01, target_rate=0.1, **options
    )
    generator, rows = torch.Generator().manual_seed(0), 64
    for _ in range(250):
        agent.update(
            dict(
                observations=torch.randn(rows, S, generator=generator),
                actions=0.2 * torch.rand(rows, 1, generator=generator) - 0.5,
                rewards=torch.ones(rows),
                next_observations=torch.randn(rows, S, generator=generator),
                discounts=torch.full((rows,), 0.5),
                returns=torch.full((rows,), 2.0),
                following_observations=torch.randn(rows, S, generator=generator),
            )
        )
        agent.update_index += 1
    states = torch.randn(500, S, generator=generator)
    drawn, _ = agent.actor.sample(states, generator=generator)
    recorded = 0.2 * torch.rand(500, 1, generator=generator) - 0.5
    return tuple(float(agent.critics(states, actions).min(0).values.mean().detach()) for actions in (drawn, recorded))  # pyright: ignore[reportReturnType]


@pytest.mark.slow
def test_cqls_q_lies_below_the_true_value_and_sacs_does_not() -> None:
    assert learned_value(SAC)[0] == pytest.approx(2.0, rel=0.05)
    assert learned_value(CQL, cql_weight=1.0)[0] < 1.9
