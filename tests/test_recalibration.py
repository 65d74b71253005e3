"""Predictive intervals scaled on validation episodes: the factor by hand, and what the transformer makes of it."""

import pytest
import torch

from envtf_lit.world_models.forecast import Trajectories, forecast
from envtf_lit.world_models.transformer import EnvironmentTransformer
from envtf_lit.world_models.uncertainty.recalibration import (
    fitted_tail,
    normal_scores,
    variance_factor,
)
from envtf_lit.world_models.uncertainty.tails import MOST, half_width, log_density, normal_score, stretch
from tests.transformers import A, S, batch_of, make_model, one_step, sequences


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


def student(degrees: float) -> torch.Tensor:
    torch.manual_seed(0)
    return torch.distributions.StudentT(degrees).sample((40_000, 2)).double()


def test_heavy_tails_are_covered_nine_times_in_ten():
    draws = student(3.0) * 3.0**-0.5  # of unit variance
    before = (draws.abs() <= half_width(0.9)).double().mean()
    factor = variance_factor(draws[:20_000])
    covered = [(draws[20_000:] / factor.sqrt()).abs().le(half_width(level)).double().mean() for level in (0.5, 0.9)]
    assert before > 0.93
    assert float(covered[1]) == pytest.approx(0.9, abs=0.01)
    assert 0.55 < float(covered[0]) < 0.62  # 0.60 of a t with three degrees of freedom: what a tail is for


@pytest.mark.parametrize("degrees", [3.0, 10.0, 1e6])
def test_a_tail_makes_intervals_right_at_every_level(degrees):
    fitting, judged = student(degrees).split(20_000)
    std = variance_factor(fitting).sqrt()
    tail = fitted_tail(fitting / std)
    scores = normal_score(judged / std, tail)
    for level in (0.1, 0.3, 0.5, 0.7, 0.9, 0.95, 0.99):
        assert float(scores.abs().le(half_width(level)).double().mean()) == pytest.approx(level, abs=0.015)
    assert float(tail.max()) < 0.1 if degrees == 1e6 else float(tail.min()) > 0.1


def test_tails_stay_within_bounds():
    narrow, wide = torch.full((20,), 1e-6), torch.full((20,), 1.5)
    broken = torch.full((20,), torch.nan)
    tail = fitted_tail(torch.stack([narrow, wide, broken], 1))
    assert tail.tolist() == pytest.approx([MOST, 0.0, 0.0], abs=0.002)
    assert torch.equal(fitted_tail(torch.ones(8, 2)), torch.zeros(2))  # too few


def noisy_episodes(model: EnvironmentTransformer) -> Trajectories:
    """What happens differs from what the model predicts by three of its standard deviations, with heavy tails."""
    observations, actions = sequences(8, 30)
    empty = Trajectories(observations, actions, torch.zeros(8, 30, S + 1), torch.tensor([30, 30, 30, 30, 20, 20, 9, 9]))
    teacher_forced = forecast(model, empty, feedback="recorded")
    noise = stretch(
        torch.randn(teacher_forced.mean.shape, generator=torch.Generator().manual_seed(5)), torch.tensor(0.3)
    )
    return Trajectories(observations, actions, teacher_forced.mean + 3 * teacher_forced.std * noise, empty.lengths)


@pytest.mark.parametrize("epistemic", ["laplace", "none", "head"])
def test_recalibrated_intervals_hold_nine_in_ten(epistemic: str):
    model = make_model(epistemic=epistemic)
    if epistemic == "laplace":
        model.fit_epistemic([batch_of(*sequences(40, 6))], generator=torch.Generator().manual_seed(0))
    episodes = noisy_episodes(model)
    model.recalibrate(episodes)
    torch.testing.assert_close(model.recalibration, torch.full((S + 1,), 9.0), rtol=0.35, atol=0)
    residuals = normal_scores(forecast(model, episodes, feedback="recorded"), episodes)
    covered = (residuals.abs() <= half_width(0.9) + 1e-5).double().mean(0)
    assert covered.tolist() == pytest.approx([162 / 178] * (S + 1))  # the 178 steps' ceil(0.9 * 179)-th residual
    assert (residuals.abs() <= half_width(0.5) + 1e-3).double().mean(0).tolist() == pytest.approx(
        [0.5] * (S + 1), abs=0.02
    )
    once = model.recalibration.clone(), model.tail.clone()
    model.recalibrate(episodes)  # starts afresh
    torch.testing.assert_close((model.recalibration, model.tail), once)


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
    assert torch.equal(model.recalibration, torch.ones(S + 1)) and torch.equal(model.tail, torch.zeros(S + 1))


def test_draws_and_their_density_have_the_tails():
    model, (observations, actions) = make_model(), sequences(4_000, 1)
    model.tail.fill_(0.9)
    state = model.init(observations[:1].expand(4_000, -1, -1), actions[:, :0], torch.ones(4_000).long())
    _, drawn = model.step(
        state, actions[:1, 0].expand(4_000, -1), mode="sample", generator=torch.Generator().manual_seed(1)
    )
    outcome = torch.cat([drawn.observation, drawn.reward[:, None]], 1)
    z = ((outcome - drawn.mean) / drawn.aleatoric).detach()
    score = normal_score(z, torch.tensor(0.9))
    for level in (0.5, 0.99):
        assert float(score.abs().le(half_width(level)).double().mean()) == pytest.approx(level, abs=0.01)
    density = log_density(z, torch.tensor(0.9)) - drawn.aleatoric.log()
    torch.testing.assert_close(drawn.log_prob, density.sum(1), rtol=1e-3, atol=1e-2)
    assert drawn.tail is not None and torch.equal(drawn.tail, model.tail)
