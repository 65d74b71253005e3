"""The guard of every training: what is not finite, or has exploded, stops it with a cause and two cures."""

import math
from collections.abc import Collection, Mapping

import torch
from torch import Tensor, nn

from envtf_lit.errors import UserError

CURES = {"": "lower learning_rate, or look for outliers with `envtf data check`"}  # where a module has none of its own
EXPLODED = 1e4  # a mean loss over z-scored targets, where a model that knows nothing has about 1
OVERFLOW = "so a value, a loss or a gradient has overflowed"


def diverged(
    label: str, when: str, name: str, value: float, cause: str, cures: Mapping[str, str] = CURES, *, epoch: int = 1
) -> UserError:
    """What to raise where a training diverged.

    Args:
        label: of what was trained.
        when: such as `in epoch 3`.
        name, value: what shows it.
        cause: a clause on the value.
        cures: the likeliest two, by the name; `` for all others.
        epoch: from 1; there is a checkpoint of the one before, if there was one.
    """
    kept = "" if epoch == 1 else " The epoch before is kept in the run's last checkpoint."
    return UserError(f"{label} diverged {when}: {name} is {value:.3g}, {cause}; {cures.get(name, cures[''])}.{kept}")


def check_epoch(
    metrics: Mapping[str, Tensor], module: nn.Module, label: str, epoch: int, cures: Mapping[str, str]
) -> None:
    """Refuses an epoch that diverged: before its checkpoint is written, so that the one before stays.

    One look at the device for all weights, once an epoch.

    Args:
        metrics: scalars that the epoch logged, by their whole names; `train/loss` is a mean over z-scored targets.
        module: what is trained.
        label: of it.
        epoch: from 1.
        cures: see `diverged`.

    Raises:
        UserError: a metric or a weight is not finite, or the loss has exploded.
    """
    names = [f"the norm of {name}" for name, _ in module.named_parameters()]
    norms = torch.stack([parameter.detach().float().norm() for parameter in module.parameters()]).tolist()
    values = {name: float(value) for name, value in metrics.items()} | dict(zip(names, norms, strict=True))
    for name, value in values.items():
        if not math.isfinite(value):
            raise diverged(label, f"in epoch {epoch}", name, value, OVERFLOW, cures, epoch=epoch)
    if (loss := values.get("train/loss", 0.0)) > EXPLODED:
        cause = "and a model that knows nothing has about 1"
        raise diverged(label, f"in epoch {epoch}", "train/loss", loss, cause, cures, epoch=epoch)


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
