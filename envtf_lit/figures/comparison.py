"""Plots of the comparison: learning curves, a panel per task, and what the kit's algorithms score over all tasks."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes

from envtf_lit.figures.style import COLOURS, drawing, write_table


def learning_curves(
    curves: pd.DataFrame,
    levels: Mapping[str, tuple[float, float]],
    path: str | Path,
    *,
    colours: Mapping[str, str],
    title: str,
) -> Path:
    """Mean scores against updates, least to greatest seed as a band: a row per robot, a column per tier.

    Args:
        curves: rows of `robot`, `tier`, `algorithm` (as the legend calls it), `seed`, `updates`, `score`.
        levels: mean and best score of the recorded episodes, by task, where they are known.
        path: PNG to write; the numbers go beside it as CSV.
        colours: of the algorithms.
        title: over all panels.
    """
    robots, tiers = curves["robot"].unique(), curves["tier"].unique()
    size = (3.0 * len(tiers) + 2.2, 2.5 * len(robots) + 0.7)
    with drawing(path, size, len(robots), len(tiers)) as (figure, axes):
        for row, robot in zip(axes, robots, strict=True):
            for axis, tier in zip(row, tiers, strict=True):
                here = curves.query("robot == @robot and tier == @tier")
                if here.empty:
                    axis.set_axis_off()
                    continue
                _panel(axis, here, colours, levels.get(f"{robot}-{tier}"))
                axis.set_title(f"{robot}-{tier}", fontsize="medium")
            row[0].set_ylabel("normalised score")
        for axis in axes[-1]:
            axis.set_xlabel("updates")
        shown = {
            label: line for axis in axes.flat for line, label in zip(*axis.get_legend_handles_labels(), strict=True)
        }
        figure.legend(shown.values(), shown.keys(), loc="outside right upper", fontsize="small")
        figure.suptitle(title)
    write_table(path, curves)
    return Path(path)


def _panel(axis: Axes, curves: pd.DataFrame, colours: Mapping[str, str], level: tuple[float, float] | None) -> None:
    for name, lines in curves.groupby("algorithm", sort=False):
        found = lines.groupby("updates")["score"].agg(["mean", "min", "max"])
        axis.plot(found.index, found["mean"], color=colours[str(name)], label=name, linewidth=1.5)
        if len(lines["seed"].unique()) > 1:
            axis.fill_between(found.index, found["min"], found["max"], color=colours[str(name)], alpha=0.15, lw=0)
    for value, style, words in zip(level or (), ("--", ":"), ("data, mean", "data, best"), strict=False):
        axis.axhline(value, color=COLOURS["data"], linestyle=style, linewidth=1.2, label=words, zorder=1)


def score_intervals(
    estimates: Sequence[tuple[str, float, float | None, float | None]],
    path: str | Path,
    *,
    colours: Mapping[str, str],
    title: str,
) -> Path:
    """A number of each algorithm with its interval, the highest at the top.

    Args:
        estimates: label, value, and the interval's ends, None where there is none.
        path: PNG to write; the numbers go beside it as CSV.
        colours: of the algorithms.
        title: over the plot.
    """
    table = pd.DataFrame(estimates, columns=["algorithm", "value", "low", "high"]).sort_values("value")
    with drawing(path, (6.4, 0.42 * len(table) + 1.2)) as (_, axes):
        axis = axes[0, 0]
        for place, (name, value, low, high) in enumerate(sorted(estimates, key=lambda row: row[1])):
            axis.plot([value], [place], "o", color=colours[name])
            if low is not None and high is not None:
                axis.plot([low, high], [place, place], color=colours[name], linewidth=3, alpha=0.5)
            axis.annotate(f"{value:.1f}", (value, place), xytext=(0, 5), textcoords="offset points", ha="center",
                          fontsize="small")  # fmt: skip
        axis.set_yticks(range(len(table)), [str(name) for name in table["algorithm"]])
        axis.set_ylim(-0.6, len(table) - 0.2)
        axis.set(xlabel="normalised score", title=title)
    write_table(path, table.iloc[::-1])
    return Path(path)
