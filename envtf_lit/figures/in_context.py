"""Plots of in-context errors: by steps of history, and by steps of the open loop after it."""

from collections.abc import Mapping
from itertools import cycle
from pathlib import Path

import numpy as np
import pandas as pd

from envtf_lit.evaluation.in_context import HISTORY, Doubt, InContextError
from envtf_lit.figures.style import COLOURS, LABELS, LINES, drawing, policy_colours, write_table

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


def bodies_apart(found: Mapping[str, np.ndarray], label: str, path: str | Path) -> Path:
    """A quantity over time, a line for each body that the same actions were done in.

    Args:
        found: body to values (T + 1,).
        label: of the quantity, with its unit.
        path: PNG to write; the numbers go beside it as CSV.
    """
    colours = policy_colours(found)
    with drawing(path, (8.4, 3.4)) as (_, axes):
        axis = axes[0, 0]
        for (name, values), (line, _) in zip(found.items(), cycle(LINES), strict=False):
            axis.plot(values, color=colours[name], linestyle=line, linewidth=2, label=name)
        axis.set(xlabel="step", ylabel=label, title="The same start and the same actions in several bodies")
        axis.margins(x=0)
        axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    tables = (pd.DataFrame({"body": n, "step": range(len(v)), "value": v}) for n, v in found.items())
    write_table(path, pd.concat(tables))
    return Path(path)


def change_curves(
    found: Mapping[str, np.ndarray], at: int, path: str | Path, *, begun: Mapping[str, np.ndarray] | None = None
) -> Path:
    """One-step errors along episodes whose body becomes another one at a step: medians, and quartiles of the first.

    Args:
        found: model to (3, T) quartiles, as of `evaluation.in_context.errors_on_the_way`.
        at: the step of the change.
        path: PNG to write; the numbers go beside it as CSV.
        begun: likewise (3, T - at), of models that were shown nothing of what came before the change; dashed.
    """
    columns, tables = ("lower", "median", "upper"), []
    with drawing(path, (10.4, 3.8)) as (_, axes):
        axis = axes[0, 0]
        for first, line, curves in ((0, "-", found), (at, "--", begun or {})):
            for name, (lower, median, upper) in curves.items():
                steps = first + np.arange(len(median))
                if not tables:
                    axis.fill_between(steps, lower, upper, color=COLOURS[name], alpha=0.15, lw=0)
                label = LABELS[name] + (",\nbegun at the change" if first else "")
                axis.plot(steps, median, color="black" if first else COLOURS[name], linestyle=line, label=label)
                values = dict(zip(columns, (lower, median, upper), strict=True))
                tables.append(pd.DataFrame({"model": name, "begun": first, "step": steps} | values))
        axis.axvline(at, color=COLOURS["threshold"], linestyle=":", linewidth=2, label="the body changes")
        axis.set(yscale="log", xlabel="step of the episode", ylabel="normalised squared error,\none step ahead")
        axis.set_title("A robot becomes another one on the way (medians; band: quartiles)")
        axis.margins(x=0)
        axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
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
