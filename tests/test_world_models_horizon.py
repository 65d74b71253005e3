"""Open-loop and teacher-forced errors against a linear world whose errors are known."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import LinearWorld, linear_data, linear_world
from torch import Tensor

from envtf_lit.data.datamodules import WindowData
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.errors import UserError
from envtf_lit.evaluation.horizon import error_quartiles, horizon_report
from envtf_lit.world_models.fit import reach
from envtf_lit.world_models.forecast import (
    Scale,
    forecast,
    median_steps_within,
    nmse,
    open_loop_error,
    segments,
    steps_within,
    whole_episodes,
)


def test_a_perfect_model_is_censored_everywhere():
    data = linear_data((30, 50, 12))
    report = horizon_report(linear_world(), whole_episodes(data, 10, seed=0), Scale.of(data))
    for steps in (*report.open_loop.values(), *report.teacher_forced.values()):
        assert steps.censored == 1.0
        assert steps.mean == pytest.approx((30 + 50 + 12) / 3)
    assert report.nmse_one_step < 1e-10
    assert report.explosion_rate == 0.0
    assert list(report.median_nmse) == [1, 5, 10, 50]


def by_hand(model, data, episode: int, *, feedback: bool) -> np.ndarray:
    """nmse_h of one episode with plain numpy in float64."""
    matrix, gain = model.matrix.double().numpy(), model.gain.double().numpy()
    columns = np.column_stack([data.observations, data.rewards]).astype(float)
    std = columns.std(0)[[0, 1, 3]]  # the third observation is constant and left out
    begin, end = data.episode_starts[episode], data.episode_ends[episode]
    state, errors = data.observations[begin].astype(float), []
    for row in range(begin, end):
        state = state if feedback else data.observations[row].astype(float)
        reward, state = state.sum(), matrix @ state + gain @ data.actions[row]
        truth = np.append(data.next_observations[row], data.rewards[row])
        errors.append(np.mean(((np.append(state, reward) - truth)[[0, 1, 3]] / std) ** 2))
    return np.array(errors)


@pytest.mark.parametrize(("feedback", "name"), [(True, "imagined"), (False, "recorded")])
def test_errors_equal_those_computed_by_hand(feedback, name):
    data, model = linear_data((20, 35), noise=0.01), linear_world(error=0.03)
    trajectories = whole_episodes(data, 2, seed=0)
    error = nmse(forecast(model, trajectories, feedback=name).mean, trajectories, Scale.of(data))
    for episode, length in enumerate((20, 35)):
        expected = by_hand(model, data, episode, feedback=feedback)
        np.testing.assert_allclose(error[episode, :length].numpy(), expected, rtol=2e-3, atol=1e-9)


def test_a_sampled_forecast_feeds_its_draws_back():
    data, scale = linear_data((40, 40)), Scale.of(linear_data((40, 40)))
    trajectories, model = whole_episodes(data, 2, seed=0), linear_world(std=0.05)

    def draw(seed: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(seed)
        return forecast(model, trajectories, feedback="imagined", mode="sample", generator=generator).mean

    assert torch.equal(draw(0), draw(0)) and not torch.equal(draw(0), draw(1))
    error = nmse(draw(0), trajectories, scale)
    assert error[:, 20:].mean() > 3 * error[:, 0].mean() > 0  # a random walk leaves the record, where the mean keeps it
    assert nmse(forecast(model, trajectories, feedback="imagined").mean, trajectories, scale).max() < 1e-8


def test_quartiles_count_those_that_last():
    error = torch.arange(1.0, 7.0)[:, None] * torch.tensor([1.0, 1e9, 1e-12, 1.0])
    found = error_quartiles(error, torch.tensor([4, 3, 3, 3, 3, 1]))
    assert found["step"].tolist() == [1, 2, 3]  # the fourth step has one trajectory left
    assert found["trajectories"].tolist() == [6, 5, 5]
    assert found["median"].tolist() == pytest.approx([3.5, 1e8, 1e-8])
    np.testing.assert_allclose([found["lower"][0], found["upper"][0]], [2.25, 4.75])


def test_open_loop_drifts_where_teacher_forcing_does_not():
    data = linear_data((200, 200, 200))
    report = horizon_report(linear_world(error=0.01), whole_episodes(data, 3, seed=0), Scale.of(data))
    assert report.open_loop[0.01].mean < 60
    assert report.teacher_forced[0.01].mean == 200
    assert report.open_loop[0.01].mean <= report.open_loop[0.1].mean
    assert report.median_nmse[100] > 10 * report.median_nmse[5]


def test_steps_within_counts_the_steps_before_the_first_error():
    error = torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.0, 0.5], [0.0, 0.5, 0.0], [0.01, 0.5, 0.5], [0.0, torch.inf, 0.0]])
    steps, censored = steps_within(error, torch.tensor([3, 3, 3, 1, 3]), 0.01)
    assert steps.tolist() == [0, 2, 1, 1, 1]  # the fourth ends after one step, exactly at the threshold
    assert censored.tolist() == [False, False, False, True, False]


def test_explosions_and_undefined_predictions_are_counted():
    data, exploding, undefined = linear_data((40, 40)), linear_world(), linear_world()
    exploding.matrix = 2.0 * exploding.matrix
    undefined.matrix = torch.full((3, 3), torch.nan)
    trajectories, scale = whole_episodes(data, 2, seed=0), Scale.of(data)
    assert horizon_report(exploding, trajectories, scale).explosion_rate == 1.0
    report = horizon_report(undefined, trajectories, scale)
    assert report.explosion_rate == 1.0
    assert report.open_loop[0.1].mean == 0.0
    assert open_loop_error(undefined, trajectories, scale) == pytest.approx(1e4)


def test_selection_prefers_the_better_model_and_is_finite_for_all():
    data = linear_data((60, 60, 60), noise=0.001)
    batch, scale = segments(data, 64, 20, seed=0), Scale.of(data)
    errors = [open_loop_error(linear_world(error), batch, scale) for error in (0.0, 0.01, 0.1, 1.0)]
    assert errors == sorted(errors)
    assert np.isfinite(errors).all()


def test_an_open_loop_after_history_is_teacher_forced_first_and_then_on_its_own():
    data, model = linear_data((20, 20), noise=0.01), linear_world(error=0.03)
    trajectories = whole_episodes(data, 2, seed=0)
    teacher_forced = forecast(model, trajectories, feedback="recorded").mean
    warm, cold = (forecast(model, trajectories, feedback="imagined", history=history).mean for history in (7, 0))
    assert torch.equal(warm[:, :8], teacher_forced[:, :8])  # the step from the true state 7 is the first of its own
    assert not torch.equal(warm[:, 8:], teacher_forced[:, 8:])
    late = segments(data, 1, 13, seed=0, whole=True)  # memory is none of this model's: only where it starts counts
    begin = data.episode_starts + 7
    for episode, row in enumerate(begin):
        late.observations[0], late.actions[0] = (
            torch.as_tensor(column[row : row + 13]) for column in (data.observations, data.actions)
        )
        torch.testing.assert_close(forecast(model, late, feedback="imagined").mean[0], warm[episode, 7:])
    assert not torch.equal(warm[:, 7:], cold[:, 7:])


def test_whole_segments_leave_out_rows_too_near_the_end():
    data = linear_data((5, 12, 8))
    whole = segments(data, 50, 8, seed=0, whole=True)
    assert whole.lengths.tolist() == [8] * 50
    first = {row.tobytes() for row in whole.observations[:, 0].numpy()}
    assert first == {data.observations[row].tobytes() for row in [*range(5, 10), 17]}
    with pytest.raises(UserError, match="No episode has the 13 steps"):
        segments(data, 1, 13, seed=0, whole=True)


def test_segments_never_cross_an_episode():
    data = linear_data((5, 30, 3))
    batch = segments(data, 200, 8, seed=1)
    last = batch.targets[:, :-1, :3]
    same = torch.isclose(last, batch.observations[:, 1:]).all(-1)
    assert bool((same | ~batch.valid[:, 1:]).all())
    assert batch.lengths.min() == 1
    assert batch.lengths.max() == 8
    assert torch.equal(batch.observations, segments(data, 200, 8, seed=1).observations)


def test_whole_episodes_start_at_the_first_step():
    data = linear_data((5, 30, 3, 8))
    chosen = whole_episodes(data, 2, seed=0)
    starts = torch.from_numpy(data.observations[data.episode_starts])
    assert len(chosen.lengths) == 2
    assert all((row == starts).all(-1).any() for row in chosen.observations[:, 0])


def test_later_trajectories_begin_where_they_are_told_to():
    data = linear_data((5, 30, 3, 8))
    whole = whole_episodes(data, 4, seed=0)
    later = whole.later(5)
    assert later.lengths.tolist() == [25, 3]
    for row, episode in enumerate((1, 3)):
        rows = slice(data.episode_starts[episode] + 5, data.episode_ends[episode])
        np.testing.assert_array_equal(later.observations[row, : later.lengths[row]], data.observations[rows])
        np.testing.assert_array_equal(later.targets[row, : later.lengths[row], :-1], data.next_observations[rows])
        np.testing.assert_array_equal(later.actions[row, : later.lengths[row]], data.actions[rows])
    assert torch.equal(whole.later(0).observations, whole.observations)


@pytest.mark.parametrize(
    ("bad", "lengths", "expected"),
    [
        ([1, 2, 3, 4], [9, 9, 9, 9], 3),  # half of them stay for three steps
        ([5, 5, None, None], [9, 9, 2, 2], 5),  # the short ones say nothing of what follows
        ([5, 7, 8, None], [9, 9, 9, 9], 8),
        ([0, 0, 0, 4], [9, 9, 9, 9], 0),
        ([None, None, None, 3], [9, 9, 9, 9], 9),
    ],
)
def test_the_median_reach_takes_ends_for_unknown(bad, lengths, expected):
    """Trajectories whose errors pass the threshold after so many steps, or never."""
    error = torch.zeros(4, 9)
    for row, steps in enumerate(bad):
        if steps is not None:
            error[row, steps:] = 1.0
    assert median_steps_within(error, torch.tensor(lengths), 0.1) == expected


@dataclass
class LearnedWorld(LinearWorld):
    """With parameters, as of a module, to tell the device by."""

    def parameters(self) -> Iterator[Tensor]:
        return iter([self.matrix])


def test_the_reach_is_that_of_the_validation_episodes_whatever_those_for_testing_hold(tmp_path: Path):
    data, found = linear_data((60,) * 12).with_split(0.5, 0), []
    assert data.held_out is not None
    for_testing = np.isin(data.episode_index, np.flatnonzero(data.held_out)[::2])
    strange = np.random.default_rng(0).normal(size=data.next_observations.shape).astype(np.float32)
    spoiled = np.where(for_testing[:, None], strange, data.next_observations[:])
    for number, log in enumerate((data, replace(data, next_observations=spoiled))):
        save_dataset(log, tmp_path / f"{number}.npz")
        windows = WindowData(str(tmp_path / f"{number}.npz"))
        windows.setup("fit")
        model = linear_world(error=0.02)
        found.append(reach(LearnedWorld(model.matrix, model.gain), windows, seed=0))
    assert found[0] == found[1] and 1 < found[0] < 60
