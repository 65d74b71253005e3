"""What no policy's values can be, and stops its training: larger than rewards allow."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from envtf_lit.divergence import OVERFLOW, diverged

SLACK, ROUGH = 2.0, 1.0  # factor, and values of a network that has learned nothing yet, by which the bound is wide
VALUES = ("q_data", "q_target", "q_policy")  # logged means that are values, in units of the return scale


def check_means(means: Mapping[str, Tensor], largest: float, label: str, epoch: int, cures: Mapping[str, str]) -> None:
    """Refuses an epoch that diverged: before its checkpoint is written, so that the one before stays.

    Upwards alone: conservative terms push values of unseen actions down as far as they like. One look at the device for
    all means, once an epoch.

    Args:
        means: scalars, over the epoch's updates, of what these logged.
        largest: `max |r| / (1 - discount)`, in units of the return scale.
        label: of the algorithm.
        epoch: from 1.
        cures: the likeliest two, by the logged name; `` for all others.

    Raises:
        UserError: one is not finite, or a value is larger than rewards allow.
    """
    bound = SLACK * largest + ROUGH
    for name, value in zip(means, torch.stack([mean.float() for mean in means.values()]).tolist(), strict=True):
        if not math.isfinite(value):
            cause = OVERFLOW
        elif name in VALUES and value > bound:
            cause = f"where rewards allow {largest:.3g} (max |reward| / (1 - discount)), so values feed on themselves"
        else:
            continue
        raise diverged(label, f"in epoch {epoch}", name, value, cause, cures, epoch=epoch)
