"""Branching, imagining, multi-step returns of imagined rollouts, and the file they are stored in."""

import pytest
import torch

from envtf_lit.errors import UserError
from envtf_lit.imagination.histories import BranchPoints
from envtf_lit.imagination.rollouts import NoisyPolicy, Rollouts, imagine
from envtf_lit.imagination.store import load_rollouts, save_rollouts
from envtf_lit.policy import TanhGaussianActor
from envtf_lit.world_models.transformer import EnvironmentTransformer
from tests.analytic import linear_data, linear_world
from tests.test_loaders import make_dataset


def make_rollouts(horizon=4, limit=0.4) -> Rollouts:
    torch.manual_seed(0)
    model, actor = EnvironmentTransformer(2, 1, layers=1, heads=1, width=8, context=8), TanhGaussianActor(2, 1)
    torch.nn.init.normal_(model.head.weight, std=1.0)
    generator = torch.Generator().manual_seed(0)
    starts = BranchPoints(make_dataset()).draw(50, 2, generator)
    fell = lambda observation: observation[:, 0] - observation[:, 1] > limit  # noqa: E731
    return imagine(model, actor, starts, horizon=horizon, terminated=fell, generator=generator, batch_size=20)


def test_histories_are_real_steps_of_the_same_episode():
    generator = torch.Generator().manual_seed(0)
    observations, actions, lengths = BranchPoints(make_dataset()).draw(200, 2, generator)
    episode = torch.as_tensor(make_dataset().episode_index)
    for row in range(200):
        rows = observations[row, : lengths[row], 0].long()
        assert (torch.diff(rows) == 1).all() and len(set(episode[rows].tolist())) == 1
        assert (actions[row, : lengths[row] - 1, 0] == 100 + rows[:-1]).all()
        start = int(torch.as_tensor(make_dataset().episode_starts)[episode[rows[-1]]])
        assert lengths[row] == min(3, int(rows[-1]) - start + 1)


def test_rows_are_branched_from_as_often_as_they_weigh():
    weights = torch.tensor([0.0, 1.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 0.0])
    starts = BranchPoints(make_dataset(), weights=weights)
    observations, _, _ = starts.draw(40_000, 0, torch.Generator().manual_seed(0))
    shares = torch.bincount(observations[:, 0, 0].long(), minlength=9) / 40_000
    torch.testing.assert_close(shares, weights / 4, atol=0.01, rtol=0)


@pytest.mark.parametrize("weights", [None, [0.0, 1.0, 0.0, 0.0, 3.0, 2.0, 0.0, 0.0, 1.0]])
@pytest.mark.parametrize("share", [1, 2, 4, 16])
def test_rows_of_shared_windows_are_real_and_as_frequent_as_they_weigh(weights: list[float] | None, share: int) -> None:
    """Nine rows, whose observations are their numbers, in episodes shorter and longer than what is shared."""
    dataset, generator = make_dataset(), torch.Generator().manual_seed(0)
    chances = torch.tensor(weights or [1.0] * 9)
    points = BranchPoints(dataset, weights=None if weights is None else chances)
    observations, actions, lengths, window = points.draw_shared(40_001, 2, share, generator)
    assert len(lengths) == len(window) == 40_001 and len(observations) == -(-40_001 // share) == len(actions)
    rows = observations[window, lengths - 1, 0].long()
    shares = torch.bincount(rows, minlength=9) / 40_001
    torch.testing.assert_close(shares, chances / chances.sum(), atol=0.015, rtol=0)
    assert (rows[chances[rows] == 0]).numel() == 0
    start = torch.as_tensor(dataset.episode_starts[dataset.episode_index])
    seen = lengths - 1  # at least the two steps that were asked for, or as many as there are; never another episode's
    assert (seen >= torch.minimum(rows - start[rows], torch.tensor(2))).all() and (rows - seen >= start[rows]).all()
    assert torch.equal(observations[window, 0, 0].long(), rows - seen)


def test_imagining_in_parts_of_shared_windows_equals_imagining_at_once() -> None:
    torch.manual_seed(0)
    model, actor = EnvironmentTransformer(2, 1, layers=1, heads=1, width=8, context=8), TanhGaussianActor(2, 1)
    starts = BranchPoints(make_dataset()).draw_shared(50, 2, 3, torch.Generator().manual_seed(0))
    never = lambda observation: torch.zeros(len(observation), dtype=torch.bool)  # noqa: E731
    run = lambda size: imagine(model, actor, starts, horizon=0, tail=2, terminated=never, batch_size=size)  # noqa: E731
    parts, whole = run(7), run(50)
    order = parts.branch + 50 * parts.step
    for name in ("observations", "next_observations", "rewards", "branch"):
        torch.testing.assert_close(vars(parts)[name][order.argsort()], vars(whole)[name])


def test_rollouts_are_chained_and_stop_where_the_robot_falls():
    rollouts = make_rollouts()
    assert 0 < rollouts.terminated.sum() < 50
    for branch in range(50):
        rows = (rollouts.branch == branch).nonzero()[:, 0]
        assert rollouts.step[rows].tolist() == list(range(len(rows)))
        assert torch.equal(rollouts.observations[rows[1:]], rollouts.next_observations[rows[:-1]])
        assert not rollouts.terminated[rows[:-1]].any()
        assert rollouts.terminated[rows[-1]] or len(rows) == 4


def test_same_seed_same_rollouts():
    first, second = make_rollouts(), make_rollouts()
    assert all(torch.equal(a, b) for a, b in zip(vars(first).values(), vars(second).values(), strict=True))


def test_multi_step_returns_against_a_plain_loop():
    rollouts = make_rollouts()
    total, end, weight = rollouts.returns(rollouts.rewards, 0.9)
    for row in range(len(rollouts)):
        rows = (rollouts.branch == rollouts.branch[row]) & (rollouts.step >= rollouts.step[row])
        rewards = rollouts.rewards[rows]
        last = rows.nonzero()[-1, 0]
        expected = sum(0.9**k * float(reward) for k, reward in enumerate(rewards))
        assert float(total[row]) == pytest.approx(expected, rel=1e-5)
        assert float(weight[row]) == pytest.approx(0.0 if rollouts.terminated[last] else 0.9 ** len(rewards))
        assert torch.equal(end[row], rollouts.next_observations[last])


def test_tails_are_deterministic_and_only_their_rewards_are_remembered():
    torch.manual_seed(0)
    model, actor = EnvironmentTransformer(2, 1, layers=1, heads=1, width=8, context=8), TanhGaussianActor(2, 1)
    starts = BranchPoints(make_dataset()).draw(10, 0, torch.Generator().manual_seed(0))
    never = lambda observation: torch.zeros(len(observation), dtype=torch.bool)  # noqa: E731
    generator = torch.Generator().manual_seed(0)
    rollouts = imagine(model, actor, starts, horizon=2, tail=3, terminated=never, generator=generator)
    assert torch.bincount(rollouts.step).tolist() == [10] * 5
    for step in range(5):
        rows = rollouts.step == step
        own = actor.act(rollouts.observations[rows], deterministic=True)
        assert torch.allclose(own, rollouts.actions[rows]) is (step >= 2)


def test_rollouts_are_halted_where_the_model_has_left_what_it_knows():
    world = linear_world(novelty=torch.tensor([0.5, 2.0, 0.9]))
    actor, data = TanhGaussianActor(3, 1), linear_data((20, 20))
    starts = BranchPoints(data).draw(3, 0, torch.Generator().manual_seed(0))
    never = lambda observation: torch.zeros(len(observation), dtype=torch.bool)  # noqa: E731
    rollouts = imagine(world, actor, starts, horizon=1, terminated=never, novelty_limit=1.0)
    assert rollouts.halted.tolist() == [False, True, False] and not rollouts.terminated.any()
    _, _, weight = rollouts.returns(rollouts.rewards, 0.9)
    assert weight.tolist() == pytest.approx([0.9] * 3)  # a truncation: what lies beyond keeps its value
    with pytest.raises(UserError, match="has no epistemic variance"):
        imagine(linear_world(), actor, starts, horizon=1, terminated=never, novelty_limit=1.0)


def test_noise_respects_the_action_range():
    actor = TanhGaussianActor(2, 1, action_low=[0.0], action_high=[4.0])
    action = NoisyPolicy(actor, 1.0).act(torch.randn(1000, 2), generator=torch.Generator().manual_seed(0))
    assert action.min() == 0.0 and action.max() == 4.0


def test_stored_rollouts_come_back_and_equal_rollouts_give_equal_bytes(tmp_path):
    rollouts = make_rollouts()
    for name in ("a.h5", "b.h5"):
        save_rollouts(rollouts, tmp_path / name, provenance={"seed": 0})
    loaded = load_rollouts(tmp_path / "a.h5")
    assert all(torch.equal(a, b) for a, b in zip(vars(rollouts).values(), vars(loaded).values(), strict=True))
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_a_file_without_rollouts_is_refused(tmp_path):
    (tmp_path / "rollouts.h5").write_bytes(b"no")
    with pytest.raises(UserError, match="holds no imagined rollouts"):
        load_rollouts(tmp_path / "rollouts.h5")
