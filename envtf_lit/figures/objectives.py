"""Plots of training objectives: what spread each asks for, given how wrong the mean is."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
import torch

from envtf_lit.figures.style import LINES, drawing, write_table
from envtf_lit.world_models.objectives import nll, paper_mse

Objective = Literal["nll", "paper_mse"]
TITLES = {"nll": "Gaussian likelihood", "paper_mse": "the paper's sampled error"}
SPREADS = np.geomspace(0.03, 3.0, 81)
DRAWS = 20_000  # of the sampled objective, for its mean
COLOURS = ("#0072B2", "#D55E00", "#009E73")


def expected_loss(objective: Objective, error: float, spread: np.ndarray) -> np.ndarray:
    """(K,) mean of an objective where the mean is off by `error`, for predicted standard deviations `spread` (K,)."""
    log_variance = torch.from_numpy(2 * np.log(spread))[:, None]  # (K, 1)
    off = torch.full_like(log_variance, error)
    if objective == "nll":
        return nll(off, log_variance, torch.zeros_like(off)).numpy()
    many = [column.expand(DRAWS, *column.shape) for column in (off, log_variance)]
    nothing = torch.full_like(many[0], -np.inf)
    drawn = torch.Generator().manual_seed(0)
    return paper_mse(*many, nothing, torch.zeros_like(many[0]), generator=drawn).mean(0).numpy()


def best_spread(objective: Objective, error: float) -> float:
    """The standard deviation, within the range that is drawn, at which an objective is least."""
    return float(SPREADS[expected_loss(objective, error, SPREADS).argmin()])


def objective_curves(objectives: Sequence[Objective], errors: Sequence[float], path: str | Path) -> Path:
    """Each objective against the predicted spread, a line for each error of the mean, with a dot where it is least.

    Args:
        objectives: a panel each.
        errors: of the mean, up to three.
        path: PNG to write; the numbers go beside it as CSV.
    """
    rows = []
    with drawing(path, (4.6 * len(objectives) + 0.4, 3.6), 1, len(objectives)) as (_, axes):
        for axis, objective in zip(axes.flat, objectives, strict=True):
            for error, colour, (line, _) in zip(errors, COLOURS, LINES, strict=False):
                loss = expected_loss(objective, error, SPREADS)
                axis.plot(SPREADS, loss, color=colour, linestyle=line, label=f"mean off by {error:g}")
                least = int(loss.argmin())
                axis.plot(SPREADS[least], loss[least], "o", color=colour, markersize=7)
                rows.append(pd.DataFrame(dict(objective=objective, error=error, spread=SPREADS, loss=loss)))
            axis.set(xscale="log", title=TITLES[objective], xlabel="predicted standard deviation")
            axis.xaxis.set_major_formatter("{x:g}")
            axis.set_ylim(-2.5, 6)
        axes[0, 0].set_ylabel("loss (dot: least)")
        axes[0, 0].legend(fontsize="small", loc="upper right")
    write_table(path, pd.concat(rows))
    return Path(path)
