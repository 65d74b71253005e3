"""Agents: phases, optimisers by name, the equations of SAC, CQL and COMBO by hand, starting from another actor."""

import math
from typing import Any

import pytest
import torch
from torch import nn

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.agents.agent import Agent
from envtf_lit.agents.bc import BC
from envtf_lit.agents.combo import COMBO
from envtf_lit.agents.cql import CQL
from envtf_lit.agents.et_cql import ETCQL, ETCQLPaper
from envtf_lit.agents.networks import StackedCritics
from envtf_lit.agents.sac import SAC
from envtf_lit.errors import UserError
from tests.hand_driven import SHORT, B, S, hand_driven, imagining, make_batch

A = 2  # actions, where no linear world is in play


IMAGINING = [(COMBO, {}), (ETCQLPaper, {}), (ETCQL, {"value_gradient": SHORT})]


def make_agent(cls: type[Agent] = CQL, **options: Any) -> Any:
    return hand_driven(cls, action_dim=A, **options)


# behaviour cloning


def test_cloning_makes_the_logs_actions_likelier():
    agent, batch = make_agent(BC, actor_learning_rate=0.01), make_batch(A)
    before = agent.actor.log_prob(batch["observations"], batch["actions"]).mean().item()
    losses = [float(agent.update(batch)["clone_loss"].detach()) for _ in range(30)]
    after = agent.actor.log_prob(batch["observations"], batch["actions"]).mean()
    assert losses[0] == pytest.approx(-before / A, rel=1e-5) and after > before + 0.5


def test_cloning_knows_real_rows_alone():
    agent, batch = make_agent(BC), make_batch(A, real=3)
    log_density = agent.actor.log_prob(batch["observations"], batch["actions"])
    torch.testing.assert_close(agent.clone_loss(batch), -log_density[:3].mean() / A)


@pytest.mark.parametrize("joints", [1, 3, 8])
def test_cloning_weighs_as_much_for_a_robot_of_any_number_of_joints(joints):
    agent, batch = hand_driven(BC, action_dim=joints), make_batch(joints)
    nn.init.zeros_(agent.actor.net[-1].weight)
    nn.init.zeros_(agent.actor.net[-1].bias)
    batch["actions"] = torch.zeros(B, joints)  # the density of a standard normal's mean
    torch.testing.assert_close(agent.clone_loss(batch), torch.tensor(0.5 * math.log(2.0 * math.pi)))


def saturated_log(share: float, rows: int, seed: int) -> dict[str, torch.Tensor]:
    """States and actions, of which such a share, the largest ones, are at their bounds."""
    generator = torch.Generator().manual_seed(seed)
    observations = torch.randn(rows, S, generator=generator)
    drive = observations @ torch.tensor([[1.0, 0.5], [-0.5, 1.0], [0.3, -0.2]])
    actions = torch.tanh(0.5 * drive + 0.1 * torch.randn(rows, A, generator=generator))
    large = drive.abs() >= drive.abs().quantile(1.0 - share, dim=0) if share > 0 else torch.zeros_like(drive).bool()
    return dict(observations=observations, actions=torch.where(large, drive.sign(), actions), real=torch.ones(rows))


@pytest.mark.parametrize(("share", "likely"), [(0.0, -2.0), (0.25, -0.6), (1.0, 0.0)])
def test_clones_of_saturated_logs_learn_actions_and_no_endless_densities(share, likely):
    """What is at a bound has a probability, of at most one; a density would tell of the clipping alone."""
    agent, log, held_out = make_agent(BC, hidden=(32, 32)), saturated_log(share, 4_000, 0), saturated_log(share, 500, 1)
    for _ in range(600):
        rows = torch.randint(4_000, (64,), generator=agent.generator)
        loss = agent.clone_loss({name: column[rows] for name, column in log.items()})
        agent.descend("actor", loss, rate=3e-3)
    found = float(agent.clone_loss(held_out).detach())
    assert likely <= found < 0.3
    assert (agent.actor.act(held_out["observations"]) - held_out["actions"]).square().mean() < 0.06
    assert all(weight.isfinite().all() for weight in agent.actor.parameters())


@pytest.mark.parametrize("mean", [-50.0, 0.0, 3.0, 50.0])
def test_the_likelihood_at_a_bound_is_a_probability_and_its_gradient_finite(mean):
    actor = TanhGaussianActor(1, 1, hidden=(4,))
    nn.init.zeros_(actor.net[-1].weight)  # pyright: ignore[reportArgumentType]
    nn.init.zeros_(actor.net[-1].bias)  # pyright: ignore[reportArgumentType]
    with torch.no_grad():
        actor.net[-1].bias[0] = mean  # pyright: ignore
    low, high = (actor.log_prob(torch.zeros(1, 1), torch.full((1, 1), bound)) for bound in (-1.0, 1.0))
    normal = torch.distributions.Normal(0.0, 1.0)
    edge = torch.atanh(torch.tensor(0.99))
    assert low <= 0 and high <= 0
    if abs(mean) < 10:
        torch.testing.assert_close(high.exp(), normal.cdf(torch.tensor(mean) - edge)[None], rtol=1e-3, atol=1e-6)
        torch.testing.assert_close(low.exp(), normal.cdf(-edge - mean)[None], rtol=1e-3, atol=1e-6)
    (low + high).backward()
    assert all(w.grad is not None and w.grad.isfinite().all() for w in actor.net[-1].parameters())


# soft actor-critic and conservative Q-learning


class ConstantCritics(nn.Module):
    """Q_1 = 5, Q_2 = 3 everywhere."""

    def forward(self, observation, action):
        return torch.tensor([5.0, 3.0])[:, None].expand(2, len(observation))


@pytest.mark.parametrize(("cls", "entropy"), [(SAC, True), (CQL, False)])
def test_td_target_takes_the_smaller_critic_and_stops_only_at_termination(cls, entropy):
    """With the entropy of the next action in soft actor-critic, without it in CQL."""
    agent, batch = make_agent(cls), make_batch(A)
    agent.target_critics = ConstantCritics()
    nn.init.constant_(agent.temperature.log_alpha, math.log(0.5))
    batch["rewards"], batch["discounts"] = torch.ones(B), torch.tensor([0.0, 0.9] * (B // 2))
    _, log_density = agent.actor.sample(batch["next_observations"], generator=torch.Generator().manual_seed(0))
    following = 3.0 - 0.5 * log_density if entropy else torch.full((B,), 3.0)
    torch.testing.assert_close(agent.td_target(batch), 1.0 + batch["discounts"] * following)


def test_the_critics_of_soft_actor_critic_regress_on_the_target():
    agent, batch = make_agent(SAC), make_batch(A)
    loss, _ = agent.critic_loss(batch)
    agent.generator.manual_seed(0)
    target, q = agent.td_target(batch), agent.critics(batch["observations"], batch["actions"])
    torch.testing.assert_close(loss, sum(0.5 * (one - target).square().mean() for one in q))


def test_conservative_gap_is_zero_for_a_flat_q_under_uniform_proposals():
    agent = make_agent()
    density = torch.full((B, 6), -A * math.log(2.0))
    q = torch.full((2, B), 7.0)
    gap = agent.conservative_gap(q, torch.full((2, B, 6), 7.0), density, torch.ones(B))
    torch.testing.assert_close(gap, torch.full((2,), A * math.log(2.0)))


def test_conservative_gap_against_a_plain_log_sum_exp():
    agent = make_agent()
    q, proposed, density = torch.randn(2, B), torch.randn(2, B, 3), torch.randn(B, 3)
    expected = torch.zeros(2)
    for n in range(2):
        for b in range(B):
            terms = [math.exp(float(proposed[n, b, j]) - float(density[b, j])) for j in range(3)]
            expected[n] += (math.log(sum(terms) / 3) - float(q[n, b])) / B
    torch.testing.assert_close(agent.conservative_gap(q, proposed, density, torch.ones(B)), expected)


@pytest.mark.parametrize(("cls", "options"), IMAGINING)
def test_q_is_pushed_up_on_real_rows_alone_or_as_in_the_paper_on_all(cls, options):
    agent, raised, everywhere = imagining(cls, **options), torch.zeros(2, B), cls is ETCQLPaper
    proposed, density = torch.zeros(2, B, 3), torch.zeros(B, 3)
    raised[:, B // 2 :] = 100.0  # imagined rows
    for real, up in ((torch.arange(B) < B // 2, 50.0 if everywhere else 0.0), (torch.ones(B), 50.0)):
        gap = agent.conservative_gap(raised, proposed, density, real.float())
        torch.testing.assert_close(gap, torch.full((2,), -up))


@pytest.mark.parametrize(("slope", "temperature"), [(0.5, 1.0), (3.0, 1.0), (3.0, 2.0)])
def test_the_soft_maximum_of_a_slope_is_known(slope, temperature):
    """Of Q = w a in one dimension, `log integral exp(w a) da = log(2 sinh w / w)`, from each kind of proposals."""
    agent, batch = hand_driven(CQL, sampled_actions=20_000, cql_temperature=temperature), make_batch(1)
    nn.init.zeros_(agent.actor.net[-1].weight)
    nn.init.zeros_(agent.actor.net[-1].bias)  # wide: a standard deviation of one before the tanh
    actions, density = agent.proposals(batch)
    w = slope / temperature
    expected = torch.full((B,), temperature * math.log(2.0 * math.sinh(w) / w))
    for kind in range(3):
        rows = slice(20_000 * kind, 20_000 * (kind + 1))
        found = agent.pushed_down(slope * actions[:, rows, 0], density[:, rows])
        torch.testing.assert_close(found, expected, atol=0.05, rtol=0)


def test_proposals_come_from_the_action_range_with_matching_densities():
    agent = make_agent(sampled_actions=500)
    actions, density = agent.proposals(make_batch(A))
    assert actions.shape == (B, 1500, A) and density.shape == (B, 1500)
    uniform = actions[:, :500]
    assert uniform.min() < -0.99 and uniform.max() > 0.99 and abs(uniform.mean()) < 0.05
    assert (density[:, :500] == -A * math.log(2.0)).all()
    for name, first in (("observations", 500), ("following_observations", 1000)):
        drawn = actions[:, first : first + 500].flatten(0, 1)
        states = make_batch(A)[name].repeat_interleave(500, 0)
        inside = drawn.abs().amax(-1) < 0.99
        expected = agent.actor.log_prob(states, drawn)[inside]
        found = density[:, first : first + 500].flatten()[inside]
        torch.testing.assert_close(found, expected, atol=1e-2, rtol=1e-3)


@pytest.mark.parametrize("cls", [SAC, CQL])
def test_each_loss_reaches_its_own_part_alone(cls):
    agent, seen = make_agent(cls), []
    for part, loss, _ in agent.losses(make_batch(A)):
        agent.zero_grad(set_to_none=True)
        loss.backward()
        reached = {name for name, weight in agent.named_parameters() if weight.grad is not None}
        assert reached == {name for name, _ in agent.named_parameters() if name.startswith(f"{part}.")}
        seen.append(part)
    assert seen == ["critics", "actor", "temperature"]
    assert all(p.requires_grad for p in agent.critics.parameters())  # held fixed for the actor's loss alone


def test_temperature_falls_when_entropy_is_above_its_target():
    agent = make_agent()
    for entropy, sign in ((-A + 1.0, 1.0), (-A - 1.0, -1.0)):
        loss = agent.temperature_loss(torch.tensor(entropy))
        (gradient,) = torch.autograd.grad(loss, agent.temperature.log_alpha)
        assert math.copysign(1.0, float(gradient)) == sign


def test_targets_and_average_move_by_their_rates():
    agent = make_agent(target_rate=0.25, actor_average=0.5)
    for follower, leader, rate in (
        (agent.target_critics, agent.critics, 0.25),
        (agent.average_actor, agent.actor, 0.5),
    ):
        before = [weight.clone() for weight in follower.parameters()]
        for weight in leader.parameters():
            nn.init.ones_(weight)
        agent.update_targets()
        for old, new in zip(before, follower.parameters(), strict=True):
            torch.testing.assert_close(new, (1.0 - rate) * old + rate)


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
        assert critics.from_observation.bias is not None and critics.out.bias is not None
        x = x @ first + critics.from_observation.bias[member]
        x = nn.functional.layer_norm(x, (16,)).relu()
        layer = critics.hidden[0]
        x = nn.functional.layer_norm(x @ layer.weight[member] + layer.bias[member], (8,)).relu()  # pyright: ignore
        x = x @ critics.out.weight[member] + critics.out.bias[member]
        torch.testing.assert_close(q[member], x[..., 0], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(critics(observation, actions[:, 0]), q[..., 0])


def test_critics_first_layer_begins_as_a_linear_layer_of_states_and_actions():
    torch.manual_seed(0)
    critics, bound = StackedCritics(30, 2, hidden=(400,), layer_norm=False), (30 + 2) ** -0.5
    for part in (critics.from_observation.weight, critics.from_action.weight, critics.from_observation.bias):
        assert part is not None and 0.97 * bound < float(part.detach().abs().max()) <= bound
    assert critics.from_action.bias is None  # one is enough for both


# the warm start


def equal_rewards(generator: torch.Generator, *, episode: int, terminated: bool) -> dict[str, torch.Tensor]:
    """Rows of episodes that earn one at each of their steps, of which they have from one to `episode` left.

    Only where they terminate does the state tell how many.
    """
    left = torch.randint(1, episode + 1, (64,), generator=generator).float()
    columns = {name: torch.randn(64, S, generator=generator) for name in ("observations", "last_observations")}
    if terminated:
        columns["observations"][:, 0] = left / episode
    columns |= dict(actions=torch.rand(64, A, generator=generator) * 2 - 1, rewards=torch.ones(64))
    return columns | dict(returns=(1 - 0.99**left) / 0.01, tails=0.99**left * (not terminated))


@pytest.mark.parametrize("terminated", [False, True])
def test_warm_started_values_see_beyond_truncations_and_not_beyond_terminations(terminated):
    """A reward of one for ever is worth 1 / (1 - .99) = 100, however soon the log was cut."""
    agent = make_agent(SAC, updates=1_000, warm_start=0.999, discount=0.99, hidden=(32, 32))
    agent.return_scale.fill_(100.0)
    for _ in range(800):
        agent.update(equal_rewards(agent.generator, episode=200, terminated=terminated))
        agent.update_index += 1
    batch = equal_rewards(agent.generator, episode=200, terminated=terminated)
    q = 100.0 * agent.critics(batch["observations"], batch["actions"])
    expected = batch["returns"] if terminated else torch.full((64,), 100.0)
    assert ((q - expected).abs() / 100.0).mean() < 0.02


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
