"""Plots of in-context errors: by steps of history, and by steps of the open loop after it."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from envtf_lit.evaluation.in_context import HISTORY, Doubt, InContextError
from envtf_lit.figures.style import COLOURS, LABELS, drawing, model_looks, write_table

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


def bodies_apart(found: Mapping[str, np.ndarray], label: str, dimension: int, path: str | Path) -> Path:
    """A dimension of the observation over time, a line for each body that the same actions were done in.

    Args:
        found: body to observations (T + 1, S), as of `evaluation.bodies.same_actions`.
        label: of the dimension, with its unit.
        dimension: which.
        path: PNG to write; the numbers go beside it as CSV.
    """
    with drawing(path, (8.0, 3.4)) as (_, axes):
        axis = axes[0, 0]
        for look, (name, observations) in zip(model_looks(found).values(), found.items(), strict=True):
            axis.plot(observations[:, dimension], color=look.colour, linestyle=look.line, label=name)
        axis.set(xlabel="step", ylabel=label, title="The same start and the same actions in several bodies")
        axis.margins(x=0)
        axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    tables = (
        pd.DataFrame({"body": name, "step": range(len(observations)), "value": observations[:, dimension]})
        for name, observations in found.items()
    )
    write_table(path, pd.concat(tables))
    return Path(path)


def change_curves(found: Mapping[str, np.ndarray], at: int, path: str | Path) -> Path:
    """One-step errors along episodes whose body becomes another one at a step: medians and quartiles.

    Args:
        found: model to (3, T) quartiles, as of `evaluation.in_context.errors_on_the_way`.
        at: the step of the change.
        path: PNG to write; the numbers go beside it as CSV.
    """
    with drawing(path, (9.0, 3.8)) as (_, axes):
        axis = axes[0, 0]
        for name, (lower, median, upper) in found.items():
            steps = np.arange(len(median))
            axis.fill_between(steps, lower, upper, color=COLOURS[name], alpha=0.15, lw=0)
            axis.plot(steps, median, color=COLOURS[name], label=LABELS[name])
        axis.axvline(at, color="black", linestyle=":", linewidth=1.4, label="the body changes")
        axis.set(yscale="log", xlabel="step of the episode", ylabel="normalised squared error, one step ahead")
        axis.set_title("A robot becomes another one on the way (median and quartiles)")
        axis.margins(x=0)
        axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    columns = ("lower", "median", "upper")
    tables = (pd.DataFrame(dict(zip(columns, curves, strict=True))).assign(model=m) for m, curves in found.items())
    write_table(path, pd.concat(tables))
    return Path(path)


def doubt_curves(found: Mapping[str, Doubt], path: str | Path) -> Path:
    """How wrong models are, and say they are, by steps of history; a panel for each.

    Args:
        found: by model.
        path: PNG to write; the numbers go beside it as CSV.
    """
    tables = []
    with drawing(path, (4.4 * len(found), 3.4), 1, len(found)) as (figure, axes):
        for axis, (name, doubt) in zip(axes.flat, found.items(), strict=True):
            axis.plot(doubt.error, color=COLOURS["recorded"], label="its error")
            axis.plot(doubt.told, color=COLOURS[name], linestyle="--", label="the spread it predicts")
            axis.set(title=LABELS[name], xlabel="steps of history", ylabel="root mean square (std)")
            axis.margins(x=0)
            if axis is not axes[0, 0]:
                axis.sharey(axes[0, 0])
                axis.label_outer()
            tables.append(pd.DataFrame({"model": name, "error": doubt.error, "told": doubt.told}))
        axes[0, 0].set_ylim(bottom=0)
        axes[0, 0].legend(fontsize="small")
        figure.suptitle("Does it know that it knows?")
    write_table(path, pd.concat(tables))
    return Path(path)
