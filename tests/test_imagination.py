"""Branch points, imagined rollouts and their multi-step returns, and the file they are stored in."""

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.errors import UserError
from envtf_lit.imagination.histories import BranchPoints, Histories
from envtf_lit.imagination.rollouts import NoisyPolicy, Rollouts, imagine
from envtf_lit.imagination.store import load_rollouts, save_rollouts
from envtf_lit.robots.tasks import get_task
from envtf_lit.world_models.observed import as_observed
from envtf_lit.world_models.transformer import EnvironmentTransformer
from tests.analytic import LinearWorld, linear_data, linear_world
from tests.hand_driven import made_rollouts
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
    drawn = BranchPoints(make_dataset()).draw(200, 2, generator)
    observations, actions, lengths = drawn.observations, drawn.actions, drawn.lengths
    assert len(drawn) == 200 and drawn.window is None
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
    drawn = starts.draw(40_000, 0, torch.Generator().manual_seed(0))
    shares = torch.bincount(drawn.observations[:, 0, 0].long(), minlength=9) / 40_000
    torch.testing.assert_close(shares, weights / 4, atol=0.01, rtol=0)


@pytest.mark.parametrize("weights", [None, [0.0, 1.0, 0.0, 0.0, 3.0, 2.0, 0.0, 0.0, 1.0]])
@pytest.mark.parametrize("length", [1, 2, 4, 16])
def test_rows_of_stretches_are_real_and_as_frequent_as_they_weigh(weights: list[float] | None, length: int) -> None:
    """Nine rows, whose observations are their numbers, in episodes shorter and longer than a stretch."""
    dataset, generator = make_dataset(), torch.Generator().manual_seed(0)
    chances = torch.tensor(weights or [1.0] * 9)
    points = BranchPoints(dataset, weights=None if weights is None else chances)
    drawn = points.draw_stretches(40_001, 2, length, generator)
    observations, lengths, window = drawn.observations, drawn.lengths, drawn.window
    assert window is not None and len(lengths) == len(window) == len(drawn) == 40_001
    assert len(observations) == -(-40_001 // length) == len(drawn.actions)
    rows = observations[window, lengths - 1, 0].long()
    shares = torch.bincount(rows, minlength=9) / 40_001
    torch.testing.assert_close(shares, chances / chances.sum(), atol=0.015, rtol=0)
    assert (rows[chances[rows] == 0]).numel() == 0
    start = torch.as_tensor(dataset.episode_starts[dataset.episode_index])
    seen = lengths - 1  # at least the two steps that were asked for, or as many as there are; never another episode's
    assert (seen >= torch.minimum(rows - start[rows], torch.tensor(2))).all() and (rows - seen >= start[rows]).all()
    assert torch.equal(observations[window, 0, 0].long(), rows - seen)


@pytest.mark.parametrize("stretches", [True, False])
def test_a_choice_of_histories_is_those_alone(stretches: bool) -> None:
    points, generator = BranchPoints(make_dataset()), torch.Generator().manual_seed(0)
    drawn = points.draw_stretches(20, 2, 4, generator) if stretches else points.draw(20, 2, generator)
    chosen = torch.tensor([3, 17, 4])
    some, world = drawn[chosen], linear_world()
    assert len(some) == 3 and torch.equal(some.lengths, drawn.lengths[chosen])
    if stretches:
        assert some.window is not None and some.window.tolist() == [0, 2, 1] and len(some.observations) == 3

    def present(histories: Histories) -> Tensor:
        """The linear world looks at the last observation alone."""
        window = torch.arange(len(histories)) if histories.window is None else histories.window
        return histories.observations[window, histories.lengths - 1]

    assert torch.equal(present(some), present(drawn)[chosen])
    whole = points.at(torch.tensor([4, 8]), 2)
    assert torch.equal(whole.begin(world), torch.tensor([[4.0, 4.0], [8.0, 8.0]]))


def test_imagining_in_batches_of_stretches_equals_imagining_at_once() -> None:
    torch.manual_seed(0)
    model, actor = EnvironmentTransformer(2, 1, layers=1, heads=1, width=8, context=8), TanhGaussianActor(2, 1)
    torch.nn.init.normal_(model.head.weight, std=1.0)
    starts = BranchPoints(make_dataset()).draw_stretches(50, 2, 3, torch.Generator().manual_seed(0))
    fell = lambda observation: observation[:, 0] > 9.0  # noqa: E731
    run = lambda size: imagine(model, actor, starts, horizon=0, expansion=3, terminated=fell, batch_size=size)  # noqa: E731
    parts, whole = run(7), run(50)
    assert 0 < whole.terminated.sum() < 50 and len(parts) == len(whole)
    for name, column in vars(whole).items():
        torch.testing.assert_close(vars(parts)[name], column, msg=name)


def test_batches_that_end_early_are_as_long_as_the_longest():
    short, long = made_rollouts([[1.0, 2.0]]), made_rollouts([[3.0], [4.0], [5.0]])
    whole = Rollouts.joined([short, long])
    assert whole.rewards.tolist() == [[1.0, 2.0, 3.0], [0.0, 0.0, 4.0], [0.0, 0.0, 5.0]]
    assert whole.valid.tolist() == [[True, True, True], [False, False, True], [False, False, True]]
    assert whole.observations.shape == (3, 3, 3) and len(whole) == 5


def test_rollouts_are_chained_and_stop_where_the_robot_falls():
    rollouts = make_rollouts()
    assert 0 < rollouts.terminated.sum() < 50
    assert rollouts.valid.shape == (4, 50) and rollouts.valid[0].all()
    ended = rollouts.terminated | rollouts.halted
    assert torch.equal(rollouts.valid[1:], rollouts.valid[:-1] & ~ended[:-1])
    goes_on = rollouts.valid[1:]
    assert torch.equal(rollouts.observations[1:][goes_on], rollouts.next_observations[:-1][goes_on])


def test_zeros_stand_where_a_rollout_has_ended_before():
    rollouts = make_rollouts()
    over = ~rollouts.valid
    assert over.any() and len(rollouts) == int((~over).sum()) < over.numel()
    assert all(not column[over].any() for column in vars(rollouts).values())
    assert rollouts.aleatoric[rollouts.valid].all() and rollouts.uncertainty[rollouts.valid].all()


def test_same_seed_same_rollouts():
    first, second = make_rollouts(), make_rollouts()
    assert all(torch.equal(a, b) for a, b in zip(vars(first).values(), vars(second).values(), strict=True))


def test_multi_step_returns_by_hand():
    """Three rollouts of one, two and three steps; the second ends with a fall, the first was given up."""
    rewards = [[1.0, 1.0, 1.0], [9.0, 2.0, 2.0], [9.0, 9.0, 4.0]]
    rollouts = made_rollouts(rewards, lengths=[1, 2, 3], fallen=(1,))
    charged = rollouts.rewards - 1.0 * rollouts.valid
    for column, rewarded in ((rollouts.rewards, 0.0), (charged, 1.0)):
        total, end, weight = rollouts.returns(column, 0.5)
        first = [1.0 - rewarded, 1.0 + 1.0 - 1.5 * rewarded, 1.0 + 1.0 + 1.0 - 1.75 * rewarded]
        assert total[0].tolist() == first
        assert total[1, 1:].tolist() == [2.0 - rewarded, 2.0 + 2.0 - 1.5 * rewarded]
        assert total[2, 2].item() == 4.0 - rewarded
        assert weight[rollouts.valid].tolist() == [0.5, 0.0, 0.125, 0.0, 0.25, 0.5]
        assert end[..., 0][rollouts.valid].tolist() == [1.0, 12.0, 23.0, 12.0, 23.0, 23.0]
    assert rollouts.rewards[0].tolist() == [1.0, 1.0, 1.0]  # untouched


def test_multi_step_returns_against_a_plain_loop():
    rollouts = make_rollouts()
    total, end, weight = rollouts.returns(rollouts.rewards, 0.9)
    for t, b in rollouts.valid.nonzero().tolist():
        last = int(rollouts.valid[:, b].sum()) - 1
        rewards = rollouts.rewards[t : last + 1, b].tolist()
        assert float(total[t, b]) == pytest.approx(sum(0.9**k * r for k, r in enumerate(rewards)), rel=1e-5)
        assert float(weight[t, b]) == pytest.approx(0.0 if rollouts.terminated[last, b] else 0.9 ** len(rewards))
        assert torch.equal(end[t, b], rollouts.next_observations[last, b])


def test_the_steps_of_the_value_expansion_are_deterministic():
    world, actor, generator = linear_world(), TanhGaussianActor(3, 1), torch.Generator().manual_seed(0)
    starts = BranchPoints(linear_data((20, 20))).draw(10, 0, generator)
    never = lambda observation: torch.zeros(len(observation), dtype=torch.bool)  # noqa: E731
    rollouts = imagine(world, actor, starts, horizon=2, expansion=3, terminated=never, generator=generator)
    assert rollouts.valid.shape == (5, 10) and rollouts.valid.all()
    for t in range(5):
        own = actor.act(rollouts.observations[t], deterministic=True)
        assert torch.allclose(own, rollouts.actions[t]) is (t >= 2)
        mean = rollouts.observations[t] @ world.matrix.T + rollouts.actions[t] @ world.gain.T
        assert torch.allclose(mean, rollouts.next_observations[t], atol=1e-6) is (t >= 2)


def test_rollouts_are_halted_where_the_model_has_left_what_it_knows():
    world = linear_world(novelty=torch.tensor([0.5, 2.0, 0.9]))
    actor, data = TanhGaussianActor(3, 1), linear_data((20, 20))
    starts = BranchPoints(data).draw(3, 0, torch.Generator().manual_seed(0))
    never = lambda observation: torch.zeros(len(observation), dtype=torch.bool)  # noqa: E731
    rollouts = imagine(world, actor, starts, horizon=1, terminated=never, novelty_limit=1.0)
    assert rollouts.halted.tolist() == [[False, True, False]] and not rollouts.terminated.any()
    _, _, weight = rollouts.returns(rollouts.rewards, 0.9)
    assert weight[0].tolist() == pytest.approx([0.9] * 3)  # a truncation: what lies beyond keeps its value
    fallen = imagine(world, actor, starts, horizon=1, terminated=lambda s: ~never(s), novelty_limit=1.0)
    assert fallen.terminated.all() and not fallen.halted.any()  # the fall comes first
    assert not imagine(world, actor, starts, horizon=1, terminated=never).halted.any()
    with pytest.raises(UserError, match="has no epistemic variance"):
        imagine(linear_world(), actor, starts, horizon=1, terminated=never, novelty_limit=1.0)


def test_a_halted_rollout_leaves():
    @dataclass
    class Lost(LinearWorld):
        """Leaves what it knows where the first dimension passes a half."""

        def step(self, state, action, **options):
            following, prediction = super().step(state, action, **options)
            return following, replace(prediction, novelty=0.5 + following[:, 0])

    world, actor = Lost(**vars(linear_world())), TanhGaussianActor(3, 1)
    starts = BranchPoints(linear_data((20, 20))).draw(30, 0, torch.Generator().manual_seed(0))
    never = lambda observation: torch.zeros(len(observation), dtype=torch.bool)  # noqa: E731
    rollouts = imagine(world, actor, starts, horizon=0, expansion=4, terminated=never, novelty_limit=1.0)
    assert torch.equal(rollouts.halted, rollouts.valid & (rollouts.next_observations[..., 0] > 0.5))
    assert torch.equal(rollouts.valid[1:], rollouts.valid[:-1] & ~rollouts.halted[:-1])
    assert 0 < rollouts.halted.sum() < 30


@pytest.mark.parametrize("task", ["hopper-medium", "walker2d-medium", "halfcheetah-medium"])
def test_imagined_velocities_stay_where_the_simulator_shows_them(task):
    robot = get_task(task).robot
    S = robot.observation_dim
    growing = LinearWorld(3.0 * torch.eye(S), torch.zeros(S, robot.action_dim), observation_dim=S)
    world, state = as_observed(growing, robot), torch.full((2, S), 2.0)
    state[1] = -2.0
    for size in (6.0, 18.0, 54.0):
        state, prediction = world.step(state, torch.zeros(2, robot.action_dim))
        assert torch.equal(world.current(state), prediction.observation)
        shown = torch.full((S,), size)
        shown[robot.clipped_from if robot.clipped_from is not None else S :] = min(size, 10.0)
        assert torch.equal(prediction.observation, torch.stack([shown, -shown]))
    assert as_observed(growing, None) is growing and (world is growing) is (task == "halfcheetah-medium")


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
