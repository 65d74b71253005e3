"""Recalibration of predictive distributions on held-out episodes: a variance factor and a tail for each output.

A Gaussian fitted by likelihood matches the mean square of its residuals. Those of a robot that touches the ground have
heavy tails, so the match is too wide for nine residuals in ten. Two numbers for each output mend that after training:
a factor makes the central 90 % intervals hold nine in ten outcomes of validation episodes, and a tail (`tails`) makes
the 50 % intervals hold half of them. The factor is that of split conformal prediction with normalised residuals
(Papadopoulos et al. 2002, Lei et al. 2018), whose guarantee asks for exchangeable residuals, unlike steps.
"""

import math

import torch
from torch import Tensor

from envtf_lit.world_models.forecast import Forecast, Trajectories
from envtf_lit.world_models.uncertainty.tails import ANCHOR, LEAST, LEVEL, MOST, half_width, normal_score, stretch

FEWEST = 9  # residuals that something is fitted to
FACTORS = 1e-4, 1e4  # least and largest; constant dimensions have no residuals to speak of


def normal_scores(teacher_forced: Forecast, trajectories: Trajectories) -> Tensor:
    """(valid steps, S + 1) of the recorded outcomes, given a teacher-forced forecast; honest ones are standard normal.

    They are `(recorded - mean) / std` where the forecast is Gaussian. A predicted std of zero gives infinity, or zero
    where the prediction is exact.
    """
    error = (trajectories.targets - teacher_forced.mean)[trajectories.valid].double()
    z = torch.where(error == 0.0, error, error / teacher_forced.std[trajectories.valid].double())
    return z if teacher_forced.tail is None else normal_score(z, teacher_forced.tail.double())


def variance_factor(residuals: Tensor) -> Tensor:
    """(K,) factors of the predictive variance under which 90 % intervals hold 90 % of the outcomes.

    Args:
        residuals: (n, K) standardised, of validation episodes. The bound is the `ceil(0.9 (n + 1))`-th smallest, which
            fewer than nine do not have: then nothing is changed.
    """
    if len(residuals) < FEWEST:
        return residuals.new_ones(residuals.shape[1])
    rank = math.ceil(LEVEL * (len(residuals) + 1))
    bound = residuals.abs().kthvalue(rank, dim=0).values  # (K,)
    return (bound / ANCHOR).square().nan_to_num(nan=FACTORS[1]).clamp(*FACTORS)


def fitted_factor_and_tail(residuals: Tensor) -> tuple[Tensor, Tensor]:
    """(K,) factors of the predictive variance, and the tails that go with them, of standardised residuals (n, K)."""
    factor = variance_factor(residuals)
    return factor, fitted_tail(residuals / factor.sqrt())


def fitted_tail(residuals: Tensor) -> Tensor:
    """(K,) tails under which 50 % intervals hold half of the outcomes, from `LEAST` to `MOST`.

    Args:
        residuals: (n, K) standardised by a std whose 90 % intervals hold what they should. Fewer than nine are taken
            for Gaussian.
    """
    least = residuals.new_full(residuals.shape[1:], LEAST)
    if len(residuals) < FEWEST:
        return torch.zeros_like(least)
    most, middle = torch.full_like(least, MOST), torch.full_like(least, half_width(0.5))
    median = residuals.abs().median(0).values
    for _ in range(40):  # bisection: the heavier the tails, the narrower the middle
        tail = 0.5 * (least + most)
        light = stretch(middle, tail) > median  # not where the median is no number
        least, most = torch.where(light, tail, least), torch.where(light, most, tail)
    return least
