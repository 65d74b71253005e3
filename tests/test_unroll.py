"""The loop that takes a world model step by step: who goes on, what was really seen, and gradients through it."""

import pytest
import torch
from torch import Tensor

from envtf_lit.world_models.unroll import unroll
from tests.analytic import LinearWorld, linear_world


def start(count: int = 3) -> Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(0))


def push(t: int, rows: Tensor, observation: Tensor) -> Tensor:
    """An action that tells the rollout and the step."""
    return (rows + 10.0 * t)[:, None]


def through(world: LinearWorld, state: Tensor, action: Tensor) -> Tensor:
    return state @ world.matrix.T + action @ world.gain.T


def test_each_step_acts_on_what_the_one_before_predicted():
    world = linear_world()
    steps = list(unroll(world, start(), push, 3))
    assert [step.index for step in steps] == [0, 1, 2]
    observation = start()
    for t, step in enumerate(steps):
        assert step.rows.tolist() == [0, 1, 2]
        torch.testing.assert_close(step.observation, observation)
        torch.testing.assert_close(step.action, torch.tensor([[0.0], [1.0], [2.0]]) + 10.0 * t)
        observation = through(world, observation, step.action)
        torch.testing.assert_close(step.prediction.observation, observation)
        torch.testing.assert_close(step.prediction.reward, step.observation.sum(-1))


def test_those_that_are_not_selected_leave_for_good():
    """Positions among those still under way; the others come to what they would have come to alone."""
    asked, keep = [], {0: None, 1: [0, 2], 2: [1], 3: None}

    def select(t: int, rows: Tensor) -> Tensor | None:
        asked.append((t, rows.tolist()))
        chosen = keep[t]
        return None if chosen is None else torch.tensor(chosen)

    steps = list(unroll(linear_world(), start(), push, 4, select=select))
    assert asked == [(0, [0, 1, 2]), (1, [0, 1, 2]), (2, [0, 2]), (3, [2])]
    assert [step.rows.tolist() for step in steps] == [[0, 1, 2], [0, 2], [2], [2]]
    alone = list(unroll(linear_world(), start(), push, 4))
    for step, whole in zip(steps, alone, strict=True):
        torch.testing.assert_close(step.action, whole.action[step.rows])
        torch.testing.assert_close(step.prediction.observation, whole.prediction.observation[step.rows])


@pytest.mark.parametrize("end", [0, 2])
def test_nothing_follows_once_none_is_left(end: int):
    acted = []

    def act(t: int, rows: Tensor, observation: Tensor) -> Tensor:
        acted.append(t)
        return push(t, rows, observation)

    none = torch.tensor([], dtype=torch.long)
    steps = list(unroll(linear_world(), start(), act, 5, select=lambda t, rows: none if t == end else None))
    assert len(steps) == len(acted) == end


def test_what_was_really_seen_takes_the_place_of_the_prediction():
    seen = {1: torch.full((2, 3), 7.0)}
    asked = []

    def observe(t: int, rows: Tensor) -> Tensor | None:
        asked.append((t, rows.tolist()))
        return seen.get(t)

    select = lambda t, rows: torch.tensor([0, 2]) if t == 1 else None  # noqa: E731
    first, second, third = unroll(linear_world(), start(), push, 3, select=select, observe=observe)
    assert asked == [(0, [0, 1, 2]), (1, [0, 2]), (2, [0, 2])]  # after those who leave have left
    torch.testing.assert_close(first.observation, start())
    torch.testing.assert_close(second.observation, seen[1])
    torch.testing.assert_close(third.observation, second.prediction.observation)


def test_the_mode_may_change_from_step_to_step():
    generator = torch.Generator().manual_seed(0)
    steps = unroll(linear_world(), start(), push, 4, mode=lambda t: "sample" if t < 2 else "mean", generator=generator)
    drawn = [not torch.equal(s.prediction.observation, s.prediction.mean[:, :-1]) for s in steps]
    assert drawn == [True, True, False, False]


def test_the_same_seed_draws_the_same():
    def last(seed: int) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        return list(unroll(linear_world(), start(), push, 3, mode="sample", generator=generator))[-1].observation

    assert torch.equal(last(0), last(0)) and not torch.equal(last(0), last(1))


def test_gradients_run_through_all_steps():
    world, level = linear_world(), torch.tensor(0.5, requires_grad=True)
    *_, last = unroll(world, start(), lambda t, rows, seen: level.expand(len(rows), 1), 3)
    last.prediction.observation.sum().backward()
    powers = [torch.linalg.matrix_power(world.matrix, k) for k in range(3)]
    expected = 3 * sum((power @ world.gain).sum() for power in powers)  # three rollouts
    torch.testing.assert_close(level.grad, expected)


def test_steps_are_taken_as_they_are_asked_for():
    acted = []

    def act(t: int, rows: Tensor, observation: Tensor) -> Tensor:
        acted.append(t)
        return push(t, rows, observation)

    steps = unroll(linear_world(), start(), act, 5)
    assert [next(steps).index, next(steps).index] == [0, 1]
    assert acted == [0, 1]
    assert list(unroll(linear_world(), start(), act, 0)) == []
