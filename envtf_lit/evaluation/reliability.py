"""Whether predicted spreads are as large as errors, and what a limit of novelty spares an imagination."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.evaluation.physics import Physics
from envtf_lit.imagination.rollouts import Rollouts
from envtf_lit.world_models.forecast import Forecast, Scale, Trajectories
from envtf_lit.world_models.interface import WorldModel

FEWEST = 5  # rollouts that quartiles are taken of


def reliability(found: Forecast, trajectories: Trajectories, scale: Scale, *, parts: int = 15) -> pd.DataFrame:
    """Predicted spread against the error that came, of one-step predictions in order of their spread.

    Every live dimension of every step counts as one prediction, in standard deviations of the data.

    Args:
        found: the forecast that was shown the true past.
        trajectories: what was forecast.
        scale: the units, and which dimensions are live.
        parts: of equal size, a row each.

    Returns:
        Columns `predicted` and `observed`, the root mean squares of the spread and of the error of each part.
    """
    columns = (found.std, found.mean - trajectories.targets)
    spread, error = ((x[trajectories.valid] / scale.std)[:, scale.live].flatten().cpu().numpy() for x in columns)
    cut = np.array_split(np.argsort(spread, kind="stable"), parts)
    means = [[float(np.sqrt(np.square(x[part]).mean())) for x in (spread, error)] for part in cut if len(part)]
    return pd.DataFrame(means, columns=["predicted", "observed"])


@torch.no_grad()
def novelty_map(
    model: WorldModel, dataset: OfflineDataset, dimensions: tuple[int, int], *, bins: int = 40, margin: float = 0.5
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How new a state is to a model, over two dimensions of the observation; the others stay at their medians.

    Args:
        model: one with an epistemic variance.
        dataset: gives the medians, also of the action, and the range.
        dimensions: two of the observation, (x, y).
        bins: points along each.
        margin: by which the map goes beyond the range at either end, as a share of it.

    Returns:
        (bins,) x, (bins,) y, and (bins, bins) `Prediction.novelty`, y first.
    """
    states, actions = np.asarray(dataset.observations), np.asarray(dataset.actions)
    axes = []
    for dimension in dimensions:
        low, high = states[:, dimension].min(), states[:, dimension].max()
        axes.append(np.linspace(low - margin * (high - low), high + margin * (high - low), bins, dtype=np.float32))
    x, y = np.meshgrid(*axes)
    points = np.tile(np.median(states, axis=0).astype(np.float32), (x.size, 1))
    points[:, dimensions[0]], points[:, dimensions[1]] = x.ravel(), y.ravel()
    action = torch.from_numpy(np.tile(np.median(actions, axis=0).astype(np.float32), (x.size, 1)))
    lengths = torch.ones(x.size, dtype=torch.int64)
    _, found = model.step(model.init(torch.from_numpy(points)[:, None], action[:, None][:, :0], lengths), action)
    assert found.novelty is not None
    return axes[0], axes[1], found.novelty.numpy().reshape(x.shape)


def imagined_errors(run: Rollouts, physics: Physics, scale: Scale) -> Tensor:
    """(H, B) true error of each imagined step: the simulator, restarted at the imagined state, says what comes next.

    Root mean square over live observation dimensions, in standard deviations of the data. NaN where no step was taken,
    where the simulator could not take the state, and where a clipped velocity hides what the state is.
    """
    live, std = scale.live[:-1], scale.std[:-1].double()
    error = torch.full(run.valid.shape, torch.nan, dtype=torch.float64)
    begun = run.observations[run.valid].double()
    true, _, _ = physics.step(begun.numpy(), run.actions[run.valid].numpy())
    off = (run.next_observations[run.valid].double() - torch.from_numpy(true)) / std
    found = off[:, live].square().mean(1).sqrt()
    error[run.valid] = torch.where(physics.robot.clipped(begun) | ~found.isfinite(), torch.nan, found)
    return error


def errors_by_step(error: Tensor, valid: Tensor) -> pd.DataFrame:
    """Quartiles of errors (H, B) by step, and the share of rollouts that take it, `valid` (H, B) bool.

    Returns:
        Columns `step`, from 1, `lower`, `median`, `upper` (NaN where fewer than five are known) and `running`.
    """
    rows: list[Sequence[float]] = []
    for step, (values, taken) in enumerate(zip(error, valid, strict=True), start=1):
        known = values[values.isfinite()].numpy()
        quartiles = np.quantile(known, (0.25, 0.5, 0.75)) if len(known) >= FEWEST else np.full(3, np.nan)
        rows.append((step, *quartiles, float(taken.double().mean())))
    return pd.DataFrame(rows, columns=["step", "lower", "median", "upper", "running"])
