"""Coverage against noise of known size; detection, ranks and errors of rollouts against hand-made cases."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from analytic import LinearWorld, linear_data, linear_world

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.errors import UserError
from envtf_lit.evaluation.calibration import (
    ProperScores,
    auroc,
    coverage,
    draw_points,
    novelties,
    proper_scores,
    rank_correlation,
    recalibrated,
    roc_curve,
    rollout_errors,
    with_uniform_actions,
)
from envtf_lit.robots.termination import never_terminated
from envtf_lit.world_models.forecast import Scale, forecast, whole_episodes
from envtf_lit.world_models.uncertainty.recalibration import normal_scores
from tests.transformers import batch_of, make_model, sequences

NOISE = 0.05


@pytest.fixture(scope="module")
def data():
    return linear_data((300,) * 6, noise=NOISE)


def covered(data, level: float, **options) -> float:
    trajectories = whole_episodes(data, 6, seed=0)
    forced = forecast(linear_world(**options), trajectories, feedback="recorded")
    return coverage(forced, trajectories, Scale.of(data), level).mean


@pytest.mark.parametrize("level", [0.5, 0.9])
def test_honest_spreads_cover_what_they_say(data, level):
    assert covered(data, level, std=NOISE) == pytest.approx(level, abs=0.02)


def test_epistemic_spread_adds_to_the_variance(data):
    split = covered(data, 0.5, std=0.6 * NOISE, epistemic=0.8 * NOISE)  # 0.36 + 0.64 = 1
    assert split == pytest.approx(covered(data, 0.5, std=NOISE), abs=0.005)


def test_overconfident_and_timid_spreads_show(data):
    assert covered(data, 0.9, std=NOISE / 5) < 0.4
    assert covered(data, 0.5, std=NOISE * 5) > 0.95


def test_constant_dimensions_are_left_out(data):
    trajectories = whole_episodes(data, 6, seed=0)
    forced = forecast(linear_world(std=NOISE), trajectories, feedback="recorded")
    result = coverage(forced, trajectories, Scale.of(data), 0.9)
    assert [value is None for value in result.by_dimension] == [False, False, True, False]
    live = [value for value in result.by_dimension if value is not None]
    assert result.mean == pytest.approx(sum(live) / 3)


def scores(data, **options) -> ProperScores:
    trajectories = whole_episodes(data, 6, seed=0)
    forced = forecast(linear_world(**options), trajectories, feedback="recorded")
    return proper_scores(forced, trajectories, Scale.of(data))


def test_honest_spreads_have_the_scores_of_gaussians(data):
    unit = NOISE / Scale.of(data).std[[0, 1, 3]].numpy()  # the third dimension is constant
    found = scores(data, std=NOISE)
    assert found.nll == pytest.approx(np.log(unit).mean() + 0.5 * np.log(2 * np.pi * np.e), abs=0.03)
    assert found.crps == pytest.approx(unit.mean() / np.sqrt(np.pi), rel=0.03)
    for std in (NOISE / 2, NOISE * 2):
        assert scores(data, std=std).nll > found.nll + 0.1
        assert scores(data, std=std).crps > found.crps * 1.05


def test_the_ranked_score_is_the_integral_that_it_stands_for():
    data = linear_data((1, 1, 1, 1))
    trajectories, scale = whole_episodes(data, 4, seed=0), Scale.of(data)
    forced = forecast(linear_world(error=0.5, std=0.2), trajectories, feedback="recorded")
    grid, expected = np.linspace(-40.0, 40.0, 400_001), []
    for column in np.flatnonzero(scale.live.numpy()):
        mean, std = (
            value[:, 0, column].double().numpy() / float(scale.std[column]) for value in (forced.mean, forced.std)
        )
        recorded = trajectories.targets[:, 0, column].double().numpy() / float(scale.std[column])
        for m, s, y in zip(mean, std, recorded, strict=True):
            below = 0.5 * torch.erfc(torch.from_numpy((m - grid) / s / np.sqrt(2.0))).numpy()
            expected.append(np.trapezoid(np.square(below - (grid >= y)), grid))
    assert proper_scores(forced, trajectories, scale).crps == pytest.approx(np.mean(expected), rel=1e-3)


def test_recalibration_mends_a_wrong_spread_and_leaves_a_fitted_one():
    halves = [whole_episodes(linear_data((300,) * 6, noise=NOISE, seed=seed), 6, seed=0) for seed in (1, 2)]
    timid = linear_world(std=3 * NOISE)
    seen, forced = (forecast(timid, half, feedback="recorded") for half in halves)
    scale = Scale.of(linear_data((300,) * 6, noise=NOISE))
    mended = recalibrated(forced, seen, halves[0])
    assert coverage(forced, halves[1], scale, 0.5).mean > 0.9
    for level in (0.5, 0.9):
        assert coverage(mended, halves[1], scale, level).mean == pytest.approx(level, abs=0.03)
    before, after = (proper_scores(run, halves[1], scale) for run in (forced, mended))
    assert after.nll < before.nll and after.crps < before.crps
    seen_mended = recalibrated(seen, seen, halves[0])
    again = recalibrated(mended, seen_mended, halves[0])
    live = scale.live  # a dimension without errors has no spread to speak of
    torch.testing.assert_close(again.std[..., live], mended.std[..., live], rtol=1e-3, atol=0)
    assert again.tail is not None and mended.tail is not None
    torch.testing.assert_close(again.tail[live], mended.tail[live], rtol=1e-2, atol=1e-3)


def test_certain_and_infinite_forecasts_have_finite_scores(data):
    assert scores(data, std=0.0).nll == 1e8
    world = linear_world(std=0.1)
    world.matrix[0, 0] = float("nan")
    trajectories = whole_episodes(data, 6, seed=0)
    found = proper_scores(forecast(world, trajectories, feedback="recorded"), trajectories, Scale.of(data))
    assert found == ProperScores(1e8, 1e8)


def test_exact_predictions_without_spread_have_no_residual():
    data = linear_data((10,))
    trajectories = whole_episodes(data, 1, seed=0)
    forced = forecast(linear_world(std=0.0), trajectories, feedback="recorded")
    residuals = normal_scores(forced, trajectories)
    assert bool((residuals[:, 2] == 0.0).all())
    assert not bool(torch.isnan(residuals).any())


# out-of-distribution pairs against in-distribution ones


def test_the_area_counts_pairs_in_the_right_order():
    # 2 stands above 1 and ties with 2; 4 stands above all three: 4.5 of 6 pairs
    assert auroc(np.array([1.0, 2.0, 3.0]), np.array([2.0, 4.0])) == pytest.approx(0.75)
    assert auroc(np.array([1.0, 2.0]), np.array([np.inf])) == 1.0
    assert auroc(np.array([5.0]), np.array([1.0, 2.0])) == 0.0
    assert auroc(np.ones(4), np.ones(3)) == 0.5


def test_the_curve_has_the_area():
    rng = np.random.default_rng(0)
    inside, outside = rng.normal(size=5_000), rng.normal(1.0, size=4_000)
    false, true = roc_curve(inside, outside)
    assert (false[0], false[-1], true[-1]) == (0.0, 1.0, 1.0)
    assert (np.diff(true) >= 0).all()
    assert np.trapezoid(true, false) == pytest.approx(auroc(inside, outside), abs=2e-3)


def test_rank_correlation_by_hand():
    assert rank_correlation(np.array([1.0, 2.0, 9.0]), np.array([0.1, 0.2, 0.3])) == pytest.approx(1.0)
    assert rank_correlation(np.array([1.0, 2.0, 9.0]), np.array([3.0, 2.0, 1.0])) == pytest.approx(-1.0)
    # ranks 1, 2.5, 2.5, 4 and 2, 1, 3, 4: covariance 3 over the root of 4.5 * 5
    ties = rank_correlation(np.array([0.0, 5.0, 5.0, 7.0]), np.array([2.0, 1.0, 3.0, 4.0]))
    assert ties == pytest.approx(3 / 22.5**0.5)
    assert rank_correlation(np.ones(3), np.array([1.0, 2.0, 3.0])) == 0.0
    assert rank_correlation(np.ones(0), np.ones(0)) == 0.0


def random_log(lengths: tuple[int, ...]) -> OfflineDataset:
    """Episodes of five observations and two actions, all numbers random."""
    rng, rows = np.random.default_rng(0), sum(lengths)
    observations, following = rng.normal(size=(2, rows, 5)).astype(np.float32)
    starts = np.cumsum([0, *lengths[:-1]])
    ends = np.isin(np.arange(rows), [*(starts[1:] - 1), rows - 1])
    return OfflineDataset(
        observations=observations,
        actions=rng.uniform(-2, 3, (rows, 2)).astype(np.float32),
        rewards=np.zeros(rows, np.float32),
        next_observations=following,
        terminated=np.zeros(rows, bool),
        truncated=ends,
        episode_starts=starts,
        action_low=np.full(2, -2, np.float32),
        action_high=np.full(2, 3, np.float32),
    )


def test_points_are_late_pairs_with_the_steps_before_them():
    log = random_log((12, 8, 15))  # two late rows, none, and five
    points = draw_points(log, 100, history=3, seed=0)
    rows = [10, 11, 30, 31, 32, 33, 34]
    assert points.histories.lengths.tolist() == [4] * 7
    for i, row in enumerate(rows):
        np.testing.assert_array_equal(points.histories.observations[i], log.observations[row - 3 : row + 1])
        np.testing.assert_array_equal(points.histories.actions[i], log.actions[row - 3 : row])
        np.testing.assert_array_equal(points.actions[i], log.actions[row])
    assert len(draw_points(log, 4, history=3, seed=0).actions) == 4
    with pytest.raises(UserError, match="No episode has more than 10 steps"):
        draw_points(log.select([1]), 4, history=3, seed=0)


def test_uniform_actions_replace_the_last_action_alone():
    log = random_log((60, 60))
    points = draw_points(log, 100, history=3, seed=0)
    other = with_uniform_actions(points, log.action_low, log.action_high, seed=0)
    assert torch.equal(other.histories.observations, points.histories.observations) and torch.equal(
        other.histories.actions, points.histories.actions
    )
    assert other.actions.dtype == torch.float32
    assert -2 <= other.actions.min() < -1.8 and 2.8 < other.actions.max() <= 3
    assert not torch.isclose(other.actions, points.actions).any()


def test_novelty_is_that_of_the_last_token_after_the_true_past():
    log, model = random_log((30, 30)), make_model()
    model.fit_epistemic([batch_of(*sequences(40, 6))], generator=torch.Generator().manual_seed(0))
    points = draw_points(log, 7, history=5, seed=0)  # the model's context is 6
    assert model.laplace is not None and model.random_features is not None
    with torch.no_grad():
        actions = torch.cat([points.histories.actions, points.actions[:, None]], 1)
        hidden, _ = model.encode(points.histories.observations, actions, cached=False)
        random = model.random_features(model.normaliser.token(points.histories.observations[:, -1], points.actions))
        expected = model.laplace.leverage(torch.cat([hidden[:, -1], random], -1)) / model.laplace.limit
    found = novelties(model, points, batch_size=3)
    assert found is not None
    np.testing.assert_allclose(found, expected.numpy(), rtol=1e-4)
    assert novelties(make_model(epistemic="none"), points) is None


# errors along rollouts


@dataclass
class TrueWorld:
    """What really happens, in place of MuJoCo: a linear world; beyond a limit it gives up, or has clipped the state."""

    world: LinearWorld
    limit: float = float("inf")
    clip: float = float("inf")

    @property
    def robot(self) -> SimpleNamespace:
        return SimpleNamespace(terminated=never_terminated, clipped=lambda states: states.abs().amax(-1) >= self.clip)

    def step(self, observations: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        state, action = torch.from_numpy(observations).float(), torch.from_numpy(actions)
        following = self.world.step(state, action)[0].double().numpy()
        following[np.abs(observations).max(1) > self.limit] = np.nan
        return following, np.zeros(len(state)), np.zeros(len(state), bool)

    def depth(self, observations: np.ndarray) -> np.ndarray:
        """As if the first column were the height."""
        return np.maximum(0.0, -observations[:, 0])


class Still:
    """No action."""

    def act(self, observation: torch.Tensor, deterministic: bool, generator=None) -> torch.Tensor:
        assert deterministic
        return torch.zeros(len(observation), 1)


def test_errors_are_those_of_each_step_from_the_imagined_state():
    data, model = linear_data((40, 40)), linear_world(error=0.05, std=0.3)
    starts, scale = draw_points(data, 6, history=2, seed=0), Scale.of(data)
    run = rollout_errors(model, Still(), starts, TrueWorld(linear_world()), scale, steps=4)  # pyright: ignore
    state, expected = starts.histories.present, []
    first = state[:, 0]
    for _ in range(4):
        imagined, true = state @ model.matrix.T, state @ linear_world().matrix.T
        error = ((imagined - true)[:, :2] / scale.std[:2]).square().mean(1).sqrt()  # the third never moves
        expected.append(error)
        state = imagined
    np.testing.assert_allclose(run.error, torch.cat(expected).numpy(), rtol=1e-4)
    assert (run.uncertainty == pytest.approx(0.3)) and run.given_up == 0.0
    assert run.depth[:6] == pytest.approx(first.clamp(max=0.0).abs().numpy()) and (run.depth > 0.0).any()


def test_what_the_simulator_cannot_take_is_left_out_and_counted():
    data = linear_data((40, 40))
    starts, scale = draw_points(data, 10, history=2, seed=0), Scale.of(data)
    states = starts.histories.present.abs().amax(1)
    physics = TrueWorld(linear_world(), limit=float(states.median()))
    run = rollout_errors(linear_world(), Still(), starts, physics, scale, steps=1)  # pyright: ignore
    assert len(run.error) == len(run.uncertainty) == 5
    assert run.given_up == pytest.approx(0.5) and run.clipped == 0.0
    assert (run.error == 0.0).all()


def test_states_whose_velocity_was_clipped_are_left_out_and_counted():
    data = linear_data((40, 40))
    starts, scale = draw_points(data, 10, history=2, seed=0), Scale.of(data)
    states = starts.histories.present.abs().amax(1).sort().values
    physics = TrueWorld(linear_world(), limit=float(states[7]), clip=float(states[5]))
    run = rollout_errors(linear_world(), Still(), starts, physics, scale, steps=1)  # pyright: ignore
    assert len(run.error) == 5
    assert (run.given_up, run.clipped) == (pytest.approx(0.2), pytest.approx(0.3))
