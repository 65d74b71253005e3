"""Predictive intervals that hold what they promise on episodes the model was not trained on.

A Gaussian fitted by likelihood matches the mean square of its residuals. Those of a robot that touches the ground have
heavy tails, so the match is too wide for nine residuals in ten. One factor for each output mends that after training:
it makes the central 90 % intervals hold nine in ten outcomes of validation episodes (split conformal prediction with
normalised residuals: Papadopoulos et al. 2002, Lei et al. 2018), whatever the residuals' distribution.
"""

import math

import torch
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.world_models.horizon import Forecast, Trajectories

LEVEL = 0.9
FACTORS = 1e-4, 1e4  # least and largest; constant dimensions have no residuals to speak of


def calibration_split(held_out: OfflineDataset) -> tuple[OfflineDataset | None, OfflineDataset]:
    """Held-out episodes that intervals are fitted to, and those they may be judged by: every other one.

    A lone episode is judged by, and nothing is fitted.
    """
    count = len(held_out.episode_starts)
    if count < 2:
        return None, held_out
    return held_out.select(range(1, count, 2)), held_out.select(range(0, count, 2))


def half_width(level: float) -> float:
    """Standard deviations on either side of the mean that hold a share `level`, in (0, 1), of a Gaussian."""
    return math.sqrt(2.0) * float(torch.erfinv(torch.tensor(level, dtype=torch.float64)))


def standardised_residuals(taught: Forecast, trajectories: Trajectories) -> Tensor:
    """(valid steps, S + 1) `(recorded - mean) / std` of a teacher-forced forecast; honest ones are standard normal.

    A predicted std of zero gives infinity, or zero where the prediction is exact.
    """
    error = (trajectories.targets - taught.mean)[trajectories.valid].double()
    std = taught.std[trajectories.valid].double()
    return torch.where(error == 0.0, error, error / std)


def variance_factor(residuals: Tensor) -> Tensor:
    """(K,) factors of the predictive variance under which 90 % intervals hold 90 % of the outcomes.

    Args:
        residuals: (n, K) standardised, of validation episodes. The bound is the `ceil(0.9 (n + 1))`-th smallest, which
            fewer than nine do not have: then nothing is changed.
    """
    n, K = residuals.shape
    rank = math.ceil(LEVEL * (n + 1))
    if rank > n:
        return torch.ones(K, dtype=residuals.dtype, device=residuals.device)
    bound = residuals.abs().kthvalue(rank, dim=0).values  # (K,)
    return (bound / half_width(LEVEL)).square().nan_to_num(nan=FACTORS[1]).clamp(*FACTORS)
