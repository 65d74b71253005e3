"""Plots of in-context errors: by steps of history, and by steps of the open loop after it."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from envtf_lit.evaluation.in_context import HISTORY, InContextError
from envtf_lit.figures.style import COLOURS, LABELS, drawing, write_table

PANELS = {
    "one_step": ("one step ahead", "steps of history"),
    "open_loop": (f"on its own, after {HISTORY} steps of history", "step h"),
}


def in_context_curves(found: Mapping[str, Mapping[str, InContextError]], path: str | Path) -> Path:
    """Median errors by history (left) and open loop after it (right), a row for each robot; bands are quartiles.

    Args:
        found: by robot, then by model.
        path: PNG to write; the numbers go beside it as CSV.
    """
    curves = {(robot, name): _curves(errors) for robot, models in found.items() for name, errors in models.items()}
    with drawing(path, (10.5, 3.4 * len(found) + 0.4), len(found), 2) as (figure, axes):
        for row, (robot, models) in zip(axes, found.items(), strict=True):
            for axis, (kind, (title, label)) in zip(row, PANELS.items(), strict=True):
                for name in models:
                    mine = curves[robot, name][kind]
                    axis.fill_between(mine["at"], mine["lower"], mine["upper"], color=COLOURS[name], alpha=0.15, lw=0)
                    axis.plot(mine["at"], mine["median"], color=COLOURS[name], label=LABELS[name])
                axis.set(yscale="log", title=f"{robot}: {title}", xlabel=label)
                axis.margins(x=0)
            row[0].set_ylabel("normalised squared error")
            row[0].axvline(HISTORY, color=COLOURS["threshold"], linestyle=":", linewidth=1.2)
        axes[0, 0].legend(fontsize="small")
        figure.suptitle("Each episode has a robot of its own, which no observation names (median and quartiles)")
    tables = (
        table.assign(robot=robot, model=name, error=kind)
        for (robot, name), kinds in curves.items()
        for kind, table in kinds.items()
    )
    write_table(path, pd.concat(tables))
    return Path(path)


def _curves(errors: InContextError) -> dict[str, pd.DataFrame]:
    """Quartiles of each kind of error, by steps of history and by steps of the model's own."""
    tables = {}
    for kind, first, (lower, median, upper) in zip(PANELS, (0, 1), (errors.one_step, errors.open_loop), strict=True):
        at = np.arange(first, first + len(median))
        tables[kind] = pd.DataFrame(dict(at=at, lower=lower, median=median, upper=upper))
    return tables
