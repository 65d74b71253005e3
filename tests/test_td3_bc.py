"""TD3+BC and ReBRAC by hand: the scale of Q, cloning alone, targets, delay, and the next actions of the log."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from envtf_lit.agents.rebrac import ReBRAC
from envtf_lit.agents.td3_bc import TD3, TD3BC
from envtf_lit.data.loaders import Transitions
from tests.analytic import linear_data
from tests.hand_driven import B, flat, hand_driven, make_batch

A = 2
BOTH = pytest.mark.parametrize("cls", [TD3BC, ReBRAC])


class Scaled(nn.Module):
    """Critics times a factor."""

    def __init__(self, critics: nn.Module, factor: float) -> None:
        super().__init__()
        self.critics, self.factor = critics, factor

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.factor * self.critics(observation, action)


class FirstAction(nn.Module):
    """Q_i(s, a) = i + a_0."""

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return torch.tensor([1.0, 2.0])[:, None] + action[:, 0]


def make_agent(cls: type[TD3], **options: Any) -> Any:
    return hand_driven(cls, action_dim=A, **options)


def batch_with_next_actions() -> dict[str, Tensor]:
    batch = make_batch(A)
    return batch | {"next_actions": -batch["actions"], "followed": torch.tensor([1.0, 0.0] * (B // 2))}


def actor_gradient(agent: Any) -> Tensor:
    loss, _ = agent.actor_loss(batch_with_next_actions())
    return torch.cat([g.flatten() for g in torch.autograd.grad(loss, list(agent.actor.parameters()))])


@BOTH
def test_ten_times_q_leaves_the_actors_gradient_as_it_is(cls: type[TD3]) -> None:
    agent = make_agent(cls)
    before = actor_gradient(agent)
    agent.critics = Scaled(agent.critics, 10.0)
    torch.testing.assert_close(actor_gradient(agent), before, rtol=1e-3, atol=1e-6)


def test_q_has_no_share_in_the_gradient_through_its_own_scale() -> None:
    """With a lambda that is not held fixed, Q over its own mean has hardly a gradient."""
    agent = make_agent(TD3BC)
    batch = make_batch(A)
    q = agent.critics(batch["observations"], agent.actor(batch["observations"]))[0]
    weights = list(agent.actor.parameters())
    expected = torch.autograd.grad(-2.5 * q.mean() / q.abs().mean().item(), weights)
    agent.clone_loss = lambda batch: torch.zeros(())
    found = torch.autograd.grad(agent.actor_loss(batch)[0], weights)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other)


def test_alpha_zero_is_behaviour_cloning() -> None:
    agent, batch = make_agent(TD3BC, alpha=0.0), make_batch(A)
    expected = (agent.actor(batch["observations"]) - batch["actions"]).square().mean()
    torch.testing.assert_close(agent.actor_loss(batch)[0], expected)
    weights = list(agent.actor.parameters())
    for one, other in zip(
        torch.autograd.grad(agent.actor_loss(batch)[0], weights), torch.autograd.grad(expected, weights), strict=True
    ):
        torch.testing.assert_close(one, other)


def test_the_target_is_the_smaller_critic_at_the_noisy_target_actor() -> None:
    agent, batch = make_agent(TD3BC, target_noise=0.0), make_batch(A)
    agent.target_critics = FirstAction()
    action = agent.target_actor(batch["next_observations"])
    torch.testing.assert_close(agent.td_target(batch), batch["rewards"] + 0.99 * (1.0 + action[:, 0]))


def test_noise_is_cut_and_the_action_stays_in_its_range() -> None:
    agent = make_agent(TD3BC, target_noise=100.0, noise_clip=0.5)
    observation = torch.randn(200, 3)
    action, noisy = agent.target_actor(observation), agent.noisy_target(observation)
    assert (noisy - action).abs().max() <= 0.5 + 1e-6
    assert noisy.abs().max() <= 1.0
    inside = action.abs() < 0.45
    assert ((noisy - action).abs()[inside] > 0.49).float().mean() > 0.9


@BOTH
def test_actor_and_targets_learn_at_every_other_update(cls: type[TD3]) -> None:
    agent, batch = make_agent(cls, actor_average=0.5), batch_with_next_actions()
    followers = (agent.actor, agent.target_actor, agent.target_critics, agent.average_actor)
    for moved in (False, True, False, True):
        before = [flat(module.state_dict()) for module in (*followers, agent.critics)]
        agent.update(batch)
        agent.update_index += 1
        after = [flat(module.state_dict()) for module in (*followers, agent.critics)]
        changed = [not torch.equal(a, b) for a, b in zip(before, after, strict=True)]
        assert changed == [moved] * 4 + [True]


def test_rebracs_critics_pay_for_next_actions_that_the_log_lacks() -> None:
    agent, batch = make_agent(ReBRAC, critic_penalty=0.5, target_noise=0.0), batch_with_next_actions()
    agent.target_critics = FirstAction()
    action = agent.target_actor(batch["next_observations"])
    squared = (action - batch["next_actions"]).square().sum(-1)
    following = 1.0 + action[:, 0] - 0.5 * batch["followed"] * squared
    torch.testing.assert_close(agent.td_target(batch), batch["rewards"] + 0.99 * following)
    assert (squared[batch["followed"] == 0] > 0).all()  # nothing is paid there nevertheless


def test_rebracs_actor_without_its_penalty_climbs_q_alone() -> None:
    agent, batch = make_agent(ReBRAC, actor_penalty=0.0), batch_with_next_actions()
    agent.critics = FirstAction()
    q = 1.0 + agent.actor(batch["observations"])[:, 0]
    torch.testing.assert_close(agent.actor_loss(batch)[0], -q.mean() / q.abs().mean())


@pytest.mark.parametrize("n_step", [1, 3])
def test_next_actions_are_those_recorded_where_the_steps_end(n_step: int) -> None:
    dataset = linear_data((4, 6))
    columns = Transitions(dataset, discount=0.9, n_step=n_step)[torch.arange(10)]
    ends = np.minimum(np.arange(10) + n_step - 1, np.repeat([3, 9], [4, 6]))
    followed = ends < np.repeat([3, 9], [4, 6])
    assert columns["followed"].tolist() == followed.astype(float).tolist()
    known = np.flatnonzero(followed)
    assert torch.equal(columns["next_actions"][known], torch.as_tensor(dataset.actions[ends[known] + 1]))
    assert torch.equal(columns["next_observations"][known], torch.as_tensor(dataset.observations[ends[known] + 1]))
