"""CQL's equations on hand-computed cases, gradient isolation, the imagined ring, and stacked critics."""

import copy
import math
from typing import Literal

import pytest
import torch
from envtf_lit.agents.ring import ImaginedRing
from torch import nn

from envtf_lit.agents.cql import CQL
from envtf_lit.agents.networks import StackedCritics
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.errors import UserError
from envtf_lit.imagination.options import ImaginationOptions
from envtf_lit.imagination.rollouts import Rollouts
from envtf_lit.policy import TanhGaussianActor

S, A, B = 3, 2, 8


def make_agent(imagination: ImaginationOptions | None = None, **options) -> CQL:
    torch.manual_seed(0)
    agent = CQL(S, A, PolicyOptions(hidden=(16, 16), warm_start=0, imagination=imagination, **options))
    agent.generator = torch.Generator().manual_seed(0)
    agent.update_index = 0
    return agent


def make_batch(agent: CQL, real: int = B) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return dict(
        observations=torch.randn(B, S, generator=generator),
        actions=torch.rand(B, A, generator=generator) * 2 - 1,
        rewards=torch.randn(B, generator=generator),
        next_observations=torch.randn(B, S, generator=generator),
        discounts=torch.full((B,), 0.99),
        returns=torch.randn(B, generator=generator),
        real=(torch.arange(B) < real).float(),
    )


class ConstantCritics(nn.Module):
    """Q_1 = 5, Q_2 = 3 everywhere."""

    def forward(self, observation, action):
        return torch.tensor([5.0, 3.0])[:, None].expand(2, len(observation))


def test_td_target_takes_the_smaller_critic_and_stops_only_at_termination():
    agent = make_agent()
    agent.target_critics = ConstantCritics()  # pyright: ignore[reportAttributeAccessIssue]
    batch = make_batch(agent)
    batch["rewards"], batch["discounts"] = torch.ones(B), torch.tensor([0.0, 0.9] * (B // 2))
    target = agent.td_target(batch, agent.generator)
    torch.testing.assert_close(target, torch.tensor([1.0, 1.0 + 0.9 * 3.0] * (B // 2)))


def test_conservative_gap_is_zero_for_a_flat_q_under_uniform_proposals():
    agent = make_agent()
    density = torch.full((B, 6), -A * math.log(2.0))
    q = torch.full((2, B), 7.0)
    gap = agent.conservative_gap(q, torch.full((2, B, 6), 7.0), density, torch.ones(B))
    torch.testing.assert_close(gap, torch.full((2,), A * math.log(2.0)))


def test_conservative_gap_against_a_plain_log_sum_exp():
    agent = make_agent(temperature=2.0)
    q, proposed, density = torch.randn(2, B), torch.randn(2, B, 3), torch.randn(B, 3)
    expected = torch.zeros(2)
    for n in range(2):
        for b in range(B):
            terms = [math.exp(float(proposed[n, b, j]) / 2.0 - float(density[b, j])) for j in range(3)]
            expected[n] += (2.0 * math.log(sum(terms) / 3) - float(q[n, b])) / B
    torch.testing.assert_close(agent.conservative_gap(q, proposed, density, torch.ones(B)), expected)


def test_penalty_up_on_real_ignores_q_at_imagined_actions():
    q, proposed, density = torch.zeros(2, B), torch.zeros(2, B, 3), torch.zeros(B, 3)
    raised = q.clone()
    raised[:, B // 2 :] = 100.0  # imagined rows
    real = (torch.arange(B) < B // 2).float()
    cases: list[tuple[Literal["real", "mixture"], bool]] = [("real", False), ("mixture", True)]
    for where, changes in cases:
        agent = make_agent(ImaginationOptions(penalty_up_on=where, buffer_size=10))
        before, after = (agent.conservative_gap(x, proposed, density, real) for x in (q, raised))
        assert torch.equal(before, after) is not changes


def test_proposals_come_from_the_action_range_with_matching_densities():
    agent = make_agent(sampled_actions=500)
    actions, density = agent.proposals(make_batch(agent), agent.generator)
    assert actions.shape == (B, 1500, A) and density.shape == (B, 1500)
    uniform = actions[:, :500]
    assert uniform.min() < -0.99 and uniform.max() > 0.99 and abs(uniform.mean()) < 0.05
    now = agent.actor.log_prob(
        make_batch(agent)["observations"].repeat_interleave(500, 0), actions[:, 500:1000].flatten(0, 1)
    )
    inside = actions[:, 500:1000].flatten(0, 1).abs().amax(-1) < 0.99
    torch.testing.assert_close(density[:, 500:1000].flatten()[inside], now[inside], atol=1e-2, rtol=1e-3)


def test_actor_loss_reaches_the_actor_alone_and_critic_loss_the_critics_alone():
    agent = make_agent()
    batch = make_batch(agent)
    loss, _ = agent.critic_loss(batch, agent.generator)
    loss.backward()
    assert all(p.grad is None for p in [*agent.actor.parameters(), *agent.target_critics.parameters(), agent.log_alpha])
    assert all(p.grad is not None for p in agent.critics.parameters())
    agent.zero_grad(set_to_none=True)
    agent.critics.requires_grad_(False)
    loss, _ = agent.actor_loss(batch, agent.generator)
    loss.backward()
    assert all(p.grad is None for p in [*agent.critics.parameters(), agent.log_alpha])
    assert all(p.grad is not None for p in agent.actor.parameters())


def test_temperature_falls_when_entropy_is_above_its_target():
    agent = make_agent()
    for entropy, sign in ((-A + 1.0, 1.0), (-A - 1.0, -1.0)):
        (gradient,) = torch.autograd.grad(agent.temperature_loss(torch.tensor(entropy)), agent.log_alpha)
        assert math.copysign(1.0, float(gradient)) == sign


def test_targets_move_by_their_rate():
    agent = make_agent(target_rate=0.25)
    before = copy.deepcopy(agent.target_critics.state_dict())
    nn.init.ones_(agent.critics.out.weight)
    agent.follow()
    expected = 0.75 * before["out.weight"] + 0.25
    torch.testing.assert_close(agent.target_critics.out.weight.data, expected)


def test_stacked_critics_equal_one_network_per_member():
    torch.manual_seed(0)
    critics = StackedCritics(S, A, n=2, hidden=(16, 8), layer_norm=True)
    critics.observation_mean += 1.0
    observation, actions = torch.randn(B, S), torch.randn(B, 4, A)
    q = critics(observation, actions)
    assert q.shape == (2, B, 4)
    for member in range(2):
        x = torch.cat([(observation - 1.0)[:, None].expand(B, 4, S), actions], -1)
        first = torch.cat([critics.from_observation.weight[member], critics.from_action.weight[member]])
        x = x @ first + critics.from_observation.bias[member] + critics.from_action.bias[member]
        x = nn.functional.layer_norm(x, (16,)).relu()
        layer = critics.hidden[0]
        x = nn.functional.layer_norm(x @ layer.weight[member] + layer.bias[member], (8,)).relu()  # pyright: ignore
        x = x @ critics.out.weight[member] + critics.out.bias[member]
        torch.testing.assert_close(q[member], x[..., 0], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(critics(observation, actions[:, 0]), q[..., 0])


def test_ring_keeps_the_newest():
    ring = ImaginedRing(S, A, capacity=5)
    column = lambda start, n: dict(  # noqa: E731
        observations=torch.zeros(n, S),
        actions=torch.zeros(n, A),
        rewards=torch.arange(start, start + n).float(),
        next_observations=torch.zeros(n, S),
        discounts=torch.zeros(n),
    )
    ring.add(column(0, 3))
    assert len(ring) == 3
    ring.add(column(3, 4))
    assert sorted(ring.get_buffer("rewards").tolist()) == [2, 3, 4, 5, 6]
    ring.add(column(7, 12))
    assert sorted(ring.get_buffer("rewards").tolist()) == [14, 15, 16, 17, 18]
    assert set(ring.draw(200, torch.Generator().manual_seed(0))["rewards"].tolist()) == {14, 15, 16, 17, 18}


def make_rollouts(n: int) -> Rollouts:
    return Rollouts(
        observations=torch.zeros(n, S),
        actions=torch.zeros(n, A),
        rewards=torch.ones(n),
        next_observations=torch.ones(n, S),
        terminated=torch.zeros(n, dtype=torch.bool),
        halted=torch.zeros(n, dtype=torch.bool),
        aleatoric=torch.zeros(n, S + 1),
        uncertainty=torch.full((n,), 0.5),
        branch=torch.arange(n),
        step=torch.zeros(n, dtype=torch.long),
    )


def test_mixing_keeps_the_real_ratio_and_charges_for_uncertainty():
    agent = make_agent(ImaginationOptions(real_ratio=0.75, penalty=2.0, refresh_every=0, buffer_size=20))
    agent.reward_std = 3.0
    agent.remember(make_rollouts(10))
    batch = make_batch(agent)
    mixed = agent.mix(batch)
    assert mixed["real"].tolist() == [1.0] * 6 + [0.0] * 2
    assert torch.equal(mixed["rewards"][:6], batch["rewards"][:6])
    assert mixed["rewards"][6:].tolist() == [1.0 - 2.0 * 3.0 * 0.5] * 2
    torch.testing.assert_close(mixed["discounts"][6:], torch.full((2,), agent.options.discount))


def test_steps_of_the_tail_enter_targets_but_not_the_ring():
    agent = make_agent(ImaginationOptions(horizon=1, tail=1, buffer_size=20), discount=0.5)
    rollouts = make_rollouts(4)
    rollouts.branch[2:] = rollouts.branch[:2]
    rollouts.step[2:] = 1  # two rollouts of two steps
    agent.remember(rollouts)
    assert agent.ring is not None and len(agent.ring) == 2
    assert agent.ring.get_buffer("rewards")[:2].tolist() == [1.5, 1.5]
    assert agent.ring.get_buffer("discounts")[:2].tolist() == [0.25, 0.25]


def test_rewards_are_divided_by_the_return_scale():
    agent = make_agent(ImaginationOptions(refresh_every=0, buffer_size=20))
    agent.return_scale.fill_(4.0)
    agent.remember(make_rollouts(2))
    assert agent.ring is not None and agent.ring.get_buffer("rewards")[:2].tolist() == [0.25, 0.25]


# starting from another policy


def scaled_actor(observation_dim: int, action_dim: int, seed: int, **limits) -> TanhGaussianActor:
    torch.manual_seed(seed)
    actor = TanhGaussianActor(observation_dim, action_dim, hidden=(16, 16), **limits)
    actor.observation_mean.copy_(torch.randn(observation_dim))
    actor.observation_std.copy_(0.5 + torch.rand(observation_dim))
    return actor


def test_an_actor_that_starts_from_another_acts_as_it_did_within_its_own_limits():
    base, mine = scaled_actor(S, A, 0), scaled_actor(S, A, 1, action_low=[-2.0] * A, action_high=[2.0] * A)
    scale = mine.observation_mean.clone(), mine.observation_std.clone()
    mine.start_from(base)
    assert torch.equal(mine.observation_mean, scale[0]) and torch.equal(mine.observation_std, scale[1])
    observation = torch.randn(B, S)
    torch.testing.assert_close(mine.act(observation), 2.0 * base.act(observation), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("size", "kept"), [((S + 1, A), {"2", "4"}), ((S, A + 1), {"2"}), ((S + 1, A + 1), {"2"})])
def test_layers_for_another_robot_begin_anew(size: tuple[int, int], kept: set[str]):
    base, mine = scaled_actor(S, A, 0), scaled_actor(*size, 1)
    fresh = {name: value.clone() for name, value in mine.net.state_dict().items()}
    mine.start_from(base)
    for name, value in mine.net.state_dict().items():
        layer = name.split(".")[0]
        if layer in kept:
            assert torch.equal(value, base.net.state_dict()[name])
        else:
            assert torch.equal(value, fresh[name]) or (layer == "0" and size[0] == S)


def test_hidden_layers_cannot_change():
    with pytest.raises(UserError, match=r"hidden is \[16, 16\] there and \[8\] here"):
        TanhGaussianActor(S, A, hidden=(8,)).start_from(scaled_actor(S, A, 0))
