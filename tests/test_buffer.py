"""Mixed batches: the ring of the newest imagined rows, the real ratio, penalties, new rounds, and checkpoints."""

from typing import Any

import pytest
import torch

from envtf_lit.agents.combo import COMBO
from envtf_lit.agents.et_cql import ETCQLPaper
from envtf_lit.imagination.buffer import ROUNDS_KEPT, Ring
from tests.hand_driven import A, B, S, hand_driven, imagination, imagined_batches, made_rollouts, make_batch

GENERATOR = torch.Generator()


def seeded() -> torch.Generator:
    return GENERATOR.manual_seed(0)


def begun(*given: Any, scale: float = 1.0, **options: Any) -> Any:
    """A source of mixed batches that has taken in its stored rollouts."""
    source = imagined_batches(*given, **options)
    source.begin(torch.tensor(scale))
    return source


def held(source: Any, column: str) -> list[float]:
    """A column of the ring's rows; of observations the first dimension."""
    values = source.ring.get_buffer(column)[: len(source.ring)]
    return (values[:, 0] if values.dim() > 1 else values).tolist()


def test_ring_keeps_the_newest():
    ring = Ring(S, A, capacity=5)
    column = lambda start, n: dict(  # noqa: E731
        observations=torch.zeros(n, S),
        actions=torch.zeros(n, A),
        rewards=torch.arange(start, start + n).float(),
        next_observations=torch.zeros(n, S),
        following_observations=torch.zeros(n, S),
        discounts=torch.zeros(n),
    )
    ring.add(column(0, 3))
    assert len(ring) == 3
    ring.add(column(3, 4))
    assert sorted(ring.get_buffer("rewards").tolist()) == [2, 3, 4, 5, 6]
    ring.add(column(7, 12))
    assert sorted(ring.get_buffer("rewards").tolist()) == [14, 15, 16, 17, 18]
    assert set(ring.draw(200, seeded())["rewards"].tolist()) == {14, 15, 16, 17, 18}


@pytest.mark.parametrize(("ratio", "kept"), [(0.75, 6), (0.5, 4), (0.05, 0), (1.0, 8)])
def test_mixing_keeps_the_real_ratio(ratio, kept):
    source, batch = begun(real_ratio=ratio), make_batch()
    mixed = source.mix(batch, 0, None, seeded())
    assert mixed["real"].tolist() == [1.0] * kept + [0.0] * (B - kept)
    for name in ("observations", "actions", "rewards", "next_observations", "following_observations", "discounts"):
        assert len(mixed[name]) == B and torch.equal(mixed[name][:kept], batch[name][:kept])
    assert mixed["rewards"][kept:].tolist() == [1.0] * (B - kept)
    assert mixed["discounts"][kept:].tolist() == pytest.approx([0.99] * (B - kept))


def test_uncertainty_is_charged_for_in_units_of_the_datas_rewards():
    source = imagined_batches(penalty=2.0)
    source.imagination.reward_std = 3.0
    source.begin(torch.tensor(1.0))
    assert held(source, "rewards") == [1.0 - 2.0 * 3.0 * 0.5] * 10


def test_rewards_are_divided_by_the_return_scale():
    source = begun(scale=4.0)
    assert held(source, "rewards") == [0.25] * 10
    source.add_rollouts(made_rollouts([[2.0]]), horizon=1)
    assert held(source, "rewards")[0] == 0.5  # over the oldest


def test_one_step_transitions_end_where_they_end():
    """Without value expansion each step stands for itself, up to the horizon."""
    stored = made_rollouts([[1.0, 10.0, 100.0], [2.0, 20.0, 200.0]], lengths=[2, 1, 2], fallen=(0, 1))
    source = begun(stored, horizon=2, value_expansion=0, discount=0.5)
    assert held(source, "observations") == [0.0, 10.0, 20.0, 1.0, 21.0]
    assert held(source, "next_observations") == [1.0, 11.0, 21.0, 2.0, 22.0]
    assert held(source, "rewards") == [1.0, 10.0, 100.0, 2.0, 200.0]
    assert held(source, "discounts") == [0.5, 0.0, 0.5, 0.0, 0.5]


def test_steps_of_the_value_expansion_enter_targets_but_not_the_ring():
    """Two of three steps lie behind the horizon; the third rollout falls before it gets there."""
    rewards = [[1.0, 1.0, 1.0], [2.0, 2.0, 2.0], [4.0, 4.0, 4.0]]
    rollouts = made_rollouts(rewards, lengths=[3, 2, 2], fallen=(2,))
    source = begun(rollouts, horizon=1, value_expansion=2, discount=0.5)
    assert len(held(source, "observations")) == 3 + 2 + 2  # of the stored ones, every step is learned from
    source.ring.count.zero_()
    source.add_rollouts(rollouts, horizon=1)
    assert held(source, "observations") == [0.0, 10.0, 20.0]
    assert held(source, "next_observations") == [3.0, 12.0, 22.0]
    assert held(source, "following_observations") == [1.0, 11.0, 21.0]
    assert held(source, "rewards") == [1.0 + 1.0 + 1.0, 1.0 + 1.0, 1.0 + 1.0]
    assert held(source, "discounts") == [0.125, 0.25, 0.0]


def test_new_rollouts_come_every_so_often_from_the_present_policy():
    source = begun(refresh_every=3, branches=4, horizon=1)
    asked, policies = [], [object() for _ in range(8)]
    lost = made_rollouts([[5.0, 5.0]], lengths=[1, 0])
    lost.halted[0, 0] = True
    source.imagination.rollouts = lambda policy, generator: asked.append((policy, generator)) or lost
    for done, policy in enumerate(policies):
        source.mix(make_batch(), done, policy, seeded())
        assert (source.cut_share is None) is (done % 3 > 0) and source.cut_share in (None, 0.5)
    assert asked == [(policies[done], GENERATOR) for done in (0, 3, 6)]
    assert held(source, "rewards")[10 % len(source.ring.rewards) :].count(5.0) <= 3
    assert sum(reward == 5.0 for reward in held(source, "rewards")) == 3


def test_a_fixed_buffer_holds_the_stored_rollouts_and_no_others():
    source = begun(made_rollouts([[1.0, 2.0]]), refresh_every=0)
    source.imagination.rollouts = lambda *_: pytest.fail("nobody asked for new ones")
    drawn = [source.mix(make_batch(), done, None, seeded())["rewards"][6:] for done in range(3)]
    assert set(torch.cat(drawn).tolist()) <= {1.0, 2.0} and sorted(held(source, "rewards")) == [1.0, 2.0]


def test_the_ring_holds_a_few_rounds_of_rollouts():
    source = begun(refresh_every=1, branches=4, horizon=2, value_expansion=1)
    assert len(source.ring) == 10  # the stored ones
    for level in (2.0, 3.0, 4.0, 5.0):
        source.add_rollouts(
            made_rollouts([[level] * 4, [level] * 4, [level] * 4]), horizon=source.imagination.options.horizon
        )
    assert len(source.ring) == ROUNDS_KEPT * 4 * 2
    assert sorted(held(source, "observations")) == sorted([0.0, 10.0, 20.0, 30.0, 1.0, 11.0, 21.0, 31.0] * ROUNDS_KEPT)
    assert min(held(source, "rewards")) > 5.0 - 1.0 and 1.0 not in held(source, "rewards")


def test_new_rollouts_are_as_the_options_say():
    """Four of them of three steps, the last two of which are the policy's deterministic actions."""
    imagined = imagination(branches=4, horizon=1, value_expansion=2)
    agent = hand_driven(COMBO, source=imagined_batches())
    rollouts = imagined.rollouts(agent.actor, seeded())
    assert rollouts.valid.shape == (3, 4) and rollouts.valid.all()
    for t in range(3):
        own = agent.actor.act(rollouts.observations[t], deterministic=True)
        assert torch.allclose(own, rollouts.actions[t]) is (t >= 1)


def test_the_ring_is_part_of_checkpoints():
    """And taking in the stored rollouts again, as a resumed run does first, changes nothing in the end."""
    first, second = (hand_driven(COMBO, source=imagined_batches(refresh_every=2)) for _ in range(2))
    for agent in (first, second):
        agent.source.begin(torch.tensor(2.0))
    first.source.add_rollouts(made_rollouts([[7.0, 8.0]]), horizon=1)
    assert held(second.source, "rewards") != held(first.source, "rewards")
    second.load_state_dict(first.state_dict())
    assert held(second.source, "rewards") == held(first.source, "rewards") and len(second.source.ring) == 12
    draws = [agent.source.ring.draw(50, seeded()) for agent in (first, second)]
    assert all(torch.equal(draws[0][name], draws[1][name]) for name in draws[0])
    second.source.begin(torch.tensor(2.0))
    assert len(second.source.ring) == 10


def test_an_agent_learns_from_mixed_batches():
    agent = hand_driven(ETCQLPaper, source=imagined_batches(real_ratio=0.5))
    agent.source.begin(torch.ones(()))
    seen, losses = [], agent.losses
    agent.losses = lambda batch: seen.append(batch) or losses(batch)
    agent.update(make_batch())
    (batch,) = seen
    assert batch["real"].tolist() == [1.0] * 4 + [0.0] * 4
