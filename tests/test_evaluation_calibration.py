"""Coverage of predictive intervals against noise of known size."""

import pytest
import torch
from analytic import linear_data, linear_world

from envtf_lit.evaluation.calibration import coverage
from envtf_lit.world_models.horizon import Scale, forecast, whole_episodes
from envtf_lit.world_models.recalibration import standardised_residuals

NOISE = 0.05


@pytest.fixture(scope="module")
def data():
    return linear_data((300,) * 6, noise=NOISE)


def covered(data, level: float, **options) -> float:
    trajectories = whole_episodes(data, 6, seed=0)
    taught = forecast(linear_world(**options), trajectories, feedback="recorded")
    return coverage(taught, trajectories, Scale.of(data), level).mean


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
    taught = forecast(linear_world(std=NOISE), trajectories, feedback="recorded")
    result = coverage(taught, trajectories, Scale.of(data), 0.9)
    assert [value is None for value in result.by_dimension] == [False, False, True, False]
    live = [value for value in result.by_dimension if value is not None]
    assert result.mean == pytest.approx(sum(live) / 3)


def test_exact_predictions_without_spread_have_no_residual():
    data = linear_data((10,))
    trajectories = whole_episodes(data, 1, seed=0)
    taught = forecast(linear_world(std=0.0), trajectories, feedback="recorded")
    residuals = standardised_residuals(taught, trajectories)
    assert bool((residuals[:, 2] == 0.0).all())
    assert not bool(torch.isnan(residuals).any())
