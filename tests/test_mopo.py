"""MOPO by hand: the published uncertainty, other models' own, and MBPO without a penalty."""

from typing import Any

import torch

from envtf_lit.agents.mopo import MOPO
from envtf_lit.agents.sac import SAC
from envtf_lit.imagination.buffer import ImaginedBatches
from tests.hand_driven import B, hand_driven, imagined_batches, made_rollouts, make_batch
from tests.worlds import linear_gaussians, source_in

ROLLOUTS = made_rollouts([[1.0, -2.0, 4.0], [3.0, 0.5, 1.0]], lengths=[2, 1, 2])


def mopo_in(source: ImaginedBatches, **options: Any) -> Any:
    agent = hand_driven(MOPO, source=source, **options)
    source.begin(torch.ones(()))
    return agent


def test_u_of_an_ensemble_is_the_largest_norm_of_a_members_deviation() -> None:
    model = linear_gaussians(members=4)
    model.elite = model.elite[:2]  # all members count, the elites or not
    agent = mopo_in(source_in(model, penalty=2.0))
    found = ROLLOUTS.rewards - agent.charged(ROLLOUTS)
    for t, b in ROLLOUTS.valid.nonzero().tolist():
        pair = model.normaliser.token(ROLLOUTS.observations[t, b], ROLLOUTS.actions[t, b])
        _, log_variance = model(pair[None])
        raw = torch.exp(0.5 * log_variance[:, 0]) * torch.tensor([1.0, 2.0, 0.5, 3.0])  # (M, S + 1), reward included
        torch.testing.assert_close(found[t, b], 2.0 * max(member.norm() for member in raw))
    assert (found[~ROLLOUTS.valid] == 0).all()


def test_imagined_rewards_pay_that_penalty() -> None:
    agent = mopo_in(source_in(linear_gaussians(), ROLLOUTS, penalty=2.0))
    expected = agent.charged(ROLLOUTS)[ROLLOUTS.valid]
    torch.testing.assert_close(agent.source.ring.rewards, expected)
    assert (expected < ROLLOUTS.rewards[ROLLOUTS.valid]).all()


def test_of_another_model_u_is_its_own_in_units_of_the_rewards_deviation() -> None:
    source = imagined_batches(penalty=3.0)
    agent = mopo_in(source)
    std = source.imagination.reward_std
    found = ROLLOUTS.rewards - agent.source.imagination.charged(ROLLOUTS)
    torch.testing.assert_close(found, 3.0 * std * ROLLOUTS.uncertainty)


def test_without_a_penalty_it_is_mbpo() -> None:
    """Soft actor-critic, to the bit, on rows whose rewards are those imagined."""
    agent = mopo_in(source_in(linear_gaussians(), ROLLOUTS, penalty=0.0))
    plain = hand_driven(SAC, clone_weight=0.0)
    assert torch.equal(agent.source.ring.rewards, ROLLOUTS.rewards[ROLLOUTS.valid])
    plain.load_state_dict({name: x for name, x in agent.state_dict().items() if not name.startswith("source.")})
    batch = make_batch(real=B // 2)
    for agents in (agent, plain):
        agents.generator.manual_seed(7)
    for mine, theirs in zip(agent.losses(batch), plain.losses(batch), strict=True):
        assert mine[0] == theirs[0] and torch.equal(mine[1], theirs[1])
