"""The guard of every training: what is not finite, or has exploded, stops it with a cause and two cures."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from envtf_lit.errors import UserError

CURES = {"": "lower learning_rate, or look for outliers with `envtf data check`"}  # where a module has none of its own
OVERFLOW = "so a value, a loss or a gradient has overflowed"


class Diverged(UserError):
    """A training that diverged: an outcome of the method and its settings, where other errors are of the use."""


@dataclass(frozen=True)
class Bound:
    """What a logged metric of a sound training stays below.

    Attributes:
        largest: value.
        cause: a clause on a larger one.
    """

    largest: float
    cause: str


def diverged(
    label: str, when: str, name: str, value: float, cause: str, cures: Mapping[str, str] = CURES, *, epoch: int = 1
) -> Diverged:
    """What to raise where a training diverged.

    Args:
        label: of what was trained.
        when: such as `in epoch 3`.
        name, value: what shows it.
        cause: a clause on the value.
        cures: the likeliest two, by the name without its split; `` for all others.
        epoch: from 1; there is a checkpoint of the one before, if there was one.
    """
    kept = "" if epoch == 1 else " The epoch before is kept in the run's last checkpoint."
    cure = cures.get(name.rpartition("/")[2], cures[""])
    return Diverged(f"{label} diverged {when}: {name} is {value:.3g}, {cause}; {cure}.{kept}")


def check_epoch(
    metrics: Mapping[str, Tensor],
    module: nn.Module,
    label: str,
    epoch: int,
    *,
    cures: Mapping[str, str] = CURES,
    bounds: Mapping[str, Bound] | None = None,
) -> None:
    """Refuses an epoch that diverged: before its checkpoint is written, so that the one before stays.

    One look at the device for all weights, once an epoch.

    Args:
        metrics: scalars that the epoch logged, by their whole names, such as `train/loss`.
        module: what is trained.
        label: of it.
        epoch: from 1.
        cures: see `diverged`.
        bounds: of some metrics.

    Raises:
        UserError: a metric or a weight is not finite, or a metric is beyond its bound.
    """
    names = [f"the norm of {name}" for name, _ in module.named_parameters()]
    norms = torch.stack([parameter.detach().float().norm() for parameter in module.parameters()]).tolist()
    values = {name: float(value) for name, value in metrics.items()} | dict(zip(names, norms, strict=True))
    for name, value in values.items():
        if not math.isfinite(value):
            raise diverged(label, f"in epoch {epoch}", name, value, OVERFLOW, cures, epoch=epoch)
    for name, bound in (bounds or {}).items():
        if values.get(name, 0.0) > bound.largest:
            raise diverged(label, f"in epoch {epoch}", name, values[name], bound.cause, cures, epoch=epoch)


def unsound(tensors: Mapping[str, Tensor], parameters: Collection[str]) -> tuple[str, float] | None:
    """The first tensor that no sound training leaves, and a value of it that shows that; None where there is none.

    Parameters are finite, no buffer is NaN, and those that are standard deviations, by their name, are finite and
    above zero.

    Args:
        tensors: a module's state, by name.
        parameters: which of them are learned.
    """
    for name, tensor in tensors.items():
        if name in parameters:
            broken = ~tensor.isfinite()
        elif name.rpartition(".")[2].rpartition("_")[2] == "std":
            broken = ~((tensor > 0) & tensor.isfinite())
        else:
            broken = tensor.isnan()
        if broken.any():
            return name, float(tensor[broken][0])
    return None
