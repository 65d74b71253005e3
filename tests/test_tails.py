"""Johnson's S_U by its definition: quantiles, density, score and draws must tell of one distribution."""

import math

import pytest
import torch
from torch import Tensor

from envtf_lit.world_models.uncertainty.tails import ANCHOR, crps, half_width, log_density, normal_score, stretch

TAILS = (0.0, 0.3, 1.0)


def tail_of(value: float) -> Tensor:
    return torch.tensor([value], dtype=torch.float64)


def quantiles(tail: float, count: int = 400_000) -> tuple[Tensor, Tensor]:
    """(count, 1) the middles of as many equal shares of the distribution, and the shares below them."""
    share = (torch.arange(count, dtype=torch.float64)[:, None] + 0.5) / count
    return stretch(math.sqrt(2.0) * torch.erfinv(2 * share - 1), tail_of(tail)), share


def test_half_widths_are_the_gaussians():
    assert half_width(0.5) == pytest.approx(0.67449, abs=1e-5)
    assert half_width(0.9) == pytest.approx(1.64485, abs=1e-5)


def test_without_a_tail_it_is_the_gaussian():
    z, tail = torch.linspace(-6.0, 6.0, 25)[:, None], torch.zeros(1)
    torch.testing.assert_close(stretch(z, tail), z, rtol=1e-5, atol=0)
    torch.testing.assert_close(
        log_density(z, tail), torch.distributions.Normal(0.0, 1.0).log_prob(z), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize("tail", TAILS)
def test_nine_outcomes_in_ten_lie_within_the_gaussians_interval(tail):
    values, _ = quantiles(tail)
    assert float((values.abs() <= ANCHOR).double().mean()) == pytest.approx(0.9, abs=1e-5)
    assert float(stretch(tail_of(-ANCHOR), tail_of(tail))) == pytest.approx(-ANCHOR)


def test_heavier_tails_leave_a_narrower_middle():
    tails = torch.tensor(TAILS)
    middle, end = (stretch(torch.full((3,), x), tails).tolist() for x in (0.67, 4.0))
    assert middle == sorted(middle, reverse=True)
    assert end == sorted(end)


@pytest.mark.parametrize("tail", TAILS)
def test_scores_undo_stretching(tail):
    score = torch.linspace(-5.0, 5.0, 41, dtype=torch.float64)[:, None]
    torch.testing.assert_close(normal_score(stretch(score, tail_of(tail)), tail_of(tail)), score)


@pytest.mark.parametrize("tail", TAILS)
def test_the_density_is_that_of_the_draws(tail):
    edges = stretch(torch.linspace(-3.0, 3.0, 2_001, dtype=torch.float64)[:, None], tail_of(tail))
    density = log_density(edges, tail_of(tail)).exp()
    mass = (0.5 * (density[1:] + density[:-1]) * edges.diff(dim=0)).cumsum(0)[:, 0]  # trapezoids
    below = torch.special.ndtr(torch.linspace(-3.0, 3.0, 2_001, dtype=torch.float64))
    torch.testing.assert_close(mass, below[1:] - below[0], rtol=0, atol=1e-5)


@pytest.mark.parametrize("tail", TAILS)
@pytest.mark.parametrize("outcome", [0.0, 0.7, -3.0, 20.0])
def test_the_score_is_the_expected_distance_less_half_that_of_two_draws(tail, outcome):
    values, share = quantiles(tail)
    between = (values * (2 * share - 1)).mean()  # E|X - X'| / 2
    expected = float((values - outcome).abs().mean() - between)
    assert float(crps(torch.tensor([outcome], dtype=torch.float64), tail_of(tail))) == pytest.approx(expected, abs=1e-4)


def test_an_infinite_outcome_scores_infinitely_badly():
    z, tail = torch.tensor([math.inf]), torch.tensor([0.5])
    assert float(log_density(z, tail)) == -math.inf
    assert float(crps(z, tail)) == math.inf


@pytest.mark.parametrize("outcome", [0.0, 1e-3, 2.0, 1e10])
def test_densities_have_the_gradients_of_finite_differences(outcome: float) -> None:
    z = torch.tensor([outcome], dtype=torch.float64, requires_grad=True)
    step = 1e-6 * max(1.0, outcome)
    (found,) = torch.autograd.grad(log_density(z, tail_of(0.7)).sum(), z)
    after, before = (log_density(z.detach() + move, tail_of(0.7)) for move in (step, -step))
    assert float(found) == pytest.approx(float(after - before) / (2 * step), rel=1e-4, abs=1e-8)
