"""Predictive intervals scaled on validation episodes: the factor by hand, and what the transformer makes of it."""

import pytest
import torch
from analytic import linear_data
from test_transformer import A, S, batch_of, make_model, one_step, sequences

from envtf_lit.world_models.horizon import Trajectories, forecast
from envtf_lit.world_models.recalibration import (
    calibration_split,
    half_width,
    standardised_residuals,
    variance_factor,
)
from envtf_lit.world_models.transformer import EnvironmentTransformer


def test_half_widths_are_the_gaussians():
    assert half_width(0.5) == pytest.approx(0.67449, abs=1e-5)
    assert half_width(0.9) == pytest.approx(1.64485, abs=1e-5)


def test_the_factor_by_hand():
    residuals = torch.stack([torch.arange(1.0, 20.0), -0.1 * torch.arange(1.0, 20.0)], 1)  # n = 19: the 18th of each
    expected = torch.tensor([18 / 1.644854, 1.8 / 1.644854]).square()
    torch.testing.assert_close(variance_factor(residuals.double()).float(), expected)


def test_fewer_than_nine_residuals_change_nothing():
    residuals = 5 * torch.ones(9, 2)
    assert torch.equal(variance_factor(residuals[:8]), torch.ones(2))
    torch.testing.assert_close(variance_factor(residuals), torch.full((2,), (5 / 1.644854) ** 2))


def test_infinite_and_vanishing_residuals_give_finite_factors():
    residuals = torch.tensor([torch.inf, torch.nan, 0.0]).expand(20, 3)
    assert variance_factor(residuals).tolist() == pytest.approx([1e4, 1e4, 1e-4])


def test_heavy_tails_are_covered_nine_times_in_ten():
    torch.manual_seed(0)
    draws = torch.distributions.StudentT(3.0).sample((40_000, 2)).double() * 3.0**-0.5  # of unit variance
    before = (draws.abs() <= half_width(0.9)).double().mean()
    factor = variance_factor(draws[:20_000])
    covered = [(draws[20_000:] / factor.sqrt()).abs().le(half_width(level)).double().mean() for level in (0.5, 0.9)]
    assert before > 0.93
    assert float(covered[1]) == pytest.approx(0.9, abs=0.01)
    assert 0.55 < float(covered[0]) < 0.62  # 0.60 of a t with three degrees of freedom


def test_every_other_held_out_episode_calibrates():
    data = linear_data((4, 5, 6, 7, 8))
    calibration, judged = calibration_split(data)
    assert calibration is not None
    assert calibration.episode_lengths.tolist() == [5, 7]
    assert judged.episode_lengths.tolist() == [4, 6, 8]
    assert calibration_split(data.select([3]))[0] is None
    assert calibration_split(data.select([3]))[1].episode_lengths.tolist() == [7]


def noisy_episodes(model: EnvironmentTransformer) -> Trajectories:
    """What happens differs from what the model predicts by three of its standard deviations, times unit noise."""
    observations, actions = sequences(8, 30)
    empty = Trajectories(observations, actions, torch.zeros(8, 30, S + 1), torch.tensor([30, 30, 30, 30, 20, 20, 9, 9]))
    taught = forecast(model, empty, feedback="recorded")
    noise = torch.randn(taught.mean.shape, generator=torch.Generator().manual_seed(5))
    return Trajectories(observations, actions, taught.mean + 3 * taught.std * noise, empty.lengths)


@pytest.mark.parametrize("epistemic", ["laplace", "none", "head"])
def test_recalibrated_intervals_hold_nine_in_ten(epistemic: str):
    model = make_model(epistemic=epistemic)
    if epistemic == "laplace":
        model.fit_epistemic([batch_of(*sequences(40, 6))], generator=torch.Generator().manual_seed(0))
    episodes = noisy_episodes(model)
    model.recalibrate(episodes)
    torch.testing.assert_close(model.recalibration, torch.full((S + 1,), 9.0), rtol=0.35, atol=0)
    residuals = standardised_residuals(forecast(model, episodes, feedback="recorded"), episodes)
    covered = (residuals.abs() <= half_width(0.9) + 1e-5).double().mean(0)
    assert covered.tolist() == pytest.approx([162 / 178] * (S + 1))  # the 178 steps' ceil(0.9 * 179)-th residual
    once = model.recalibration.clone()
    model.recalibrate(episodes)  # starts afresh
    torch.testing.assert_close(model.recalibration, once)


def test_all_of_a_prediction_is_scaled_and_its_mean_is_not():
    model, (_, actions) = make_model(), sequences(40, 6)
    model.fit_epistemic([batch_of(*sequences(40, 6))], generator=torch.Generator().manual_seed(0))
    start = torch.zeros(2, 1, S), torch.zeros(2, 0, A), torch.ones(2).long()

    @torch.no_grad()
    def deviation() -> torch.Tensor:
        state = model.init(*start, posterior=1.0, generator=torch.Generator().manual_seed(0))
        _, prediction = model.step(state, actions[:2, 0])
        return prediction.observation - prediction.mean[:, :-1]

    before, drawn = one_step(model), deviation()
    model.recalibration.fill_(4.0)
    after = one_step(model)
    assert before.epistemic is not None
    assert torch.equal(after.mean, before.mean)
    torch.testing.assert_close(after.aleatoric, 2 * before.aleatoric)
    torch.testing.assert_close(after.epistemic, 2 * before.epistemic)
    torch.testing.assert_close(after.uncertainty, 2 * before.uncertainty)
    torch.testing.assert_close(after.novelty, before.novelty)
    torch.testing.assert_close(deviation(), 2 * drawn, rtol=1e-3, atol=1e-5)


def test_the_papers_collapsed_variances_are_left_as_they_are():
    model = make_model(objective="paper_mse", epistemic="head")
    model.recalibrate(noisy_episodes(model))
    assert torch.equal(model.recalibration, torch.ones(S + 1))
