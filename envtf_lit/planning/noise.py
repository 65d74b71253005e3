"""Noise that is correlated in time: plans made with it push one way for longer, and reach farther."""

import torch
from torch import Tensor


def coloured_noise(
    count: int, steps: int, width: int, *, colour: float, generator: torch.Generator | None, device: torch.device
) -> Tensor:
    """Gaussian noise (count, steps, width) of unit variance with the spectrum `1 / f^colour` along its steps.

    Made in the frequency domain (Timmer & König 1995); the constant part has the weight of the lowest frequency, and
    `colour` 0 is white noise.
    """
    if colour == 0:
        return torch.randn(count, steps, width, generator=generator, device=device)
    frequency = torch.fft.rfftfreq(steps, device=device).clamp(min=1 / steps)
    scale = frequency ** (-colour / 2)
    parts = torch.randn(2, count, width, len(scale), generator=generator, device=device) * scale
    share = torch.full_like(scale, 4.0)  # of each frequency in the variance: real and imaginary part, on either side
    real = [0, -1] if steps % 2 == 0 else [0]  # these have a real part alone
    parts[1][..., real] = 0.0
    parts[0][..., real] *= 2**0.5
    share[real] = 2.0
    std = (share * scale.square()).sum().sqrt() / steps
    return torch.fft.irfft(torch.complex(parts[0], parts[1]), n=steps).mT / std
