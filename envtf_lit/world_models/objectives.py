"""Training objectives of the world model, one function each, on targets of unit scale.

Shapes: `mean`, `log_variance` and `target` are (..., D); the result is (...), summed over the D outputs.
"""

import math

import torch
from torch import Tensor


def nll(mean: Tensor, log_variance: Tensor, target: Tensor) -> Tensor:
    """Gaussian negative log-likelihood: `0.5 ((y - mu)^2 / v + log v + log 2 pi)`."""
    squared = (target - mean).square() * torch.exp(-log_variance)
    return 0.5 * (squared + log_variance + math.log(2 * math.pi)).sum(-1)


def beta_nll(mean: Tensor, log_variance: Tensor, target: Tensor, beta: float = 0.5) -> Tensor:
    """`stop_gradient(v^beta) * 0.5 ((y - mu)^2 / v + log v)` (Seitzer et al. 2022, equation 5).

    The weight keeps the mean learning where the variance is large; beta = 0 is `nll` without its constant.
    """
    weight = torch.exp(beta * log_variance).detach()
    squared = (target - mean).square() * torch.exp(-log_variance)
    return 0.5 * (weight * (squared + log_variance)).sum(-1)


def paper_mse(
    mean: Tensor,
    log_variance: Tensor,
    epistemic_log_variance: Tensor,
    target: Tensor,
    *,
    generator: torch.Generator | None = None,
) -> Tensor:
    """The paper's loss (section "Training"): `(phi - y)^2`, phi = f + eps, f ~ N(mu, S_au), eps ~ N(0, S_eu).

    Its expectation is `(mu - y)^2 + S_au + S_eu`, which is least at S_au = S_eu = 0: both variances collapse, so what
    they say after training is not uncertainty. Kept, exact, to reproduce the paper.
    """
    noise = torch.randn((2, *mean.shape), generator=generator, device=mean.device, dtype=mean.dtype)
    sampled = mean + torch.exp(0.5 * log_variance) * noise[0] + torch.exp(0.5 * epistemic_log_variance) * noise[1]
    return (sampled - target).square().sum(-1)
