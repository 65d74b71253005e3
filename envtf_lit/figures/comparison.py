"""Plots of the comparison: which runs there are, learning curves, scores over all tasks, and the paper's averages."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
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
        figure.suptitle(title, x=0.02, ha="left")  # of one panel, the middle would be the legend's place
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


def averages_again(averages: pd.DataFrame, tasks: int, path: str | Path) -> Path:
    """Averages as they are printed, each over its own tasks, and over the tasks that all have; the highest at the top.

    Args:
        averages: rows of `algorithm`, `printed`, `own` (tasks behind the printed one) and `equal`.
        tasks: that all have.
        path: PNG to write; the numbers go beside it as CSV.
    """
    table = averages.sort_values("equal").reset_index(drop=True)
    with drawing(path, (7.6, 0.5 * len(table) + 1.3)) as (figure, axes):
        axis = axes[0, 0]
        axis.hlines(table.index, table["printed"], table["equal"], color=COLOURS["data"], linewidth=1.5, zorder=1)
        axis.scatter(table["printed"], table.index, s=60, facecolors="white", edgecolors="black", label="as printed")
        axis.scatter(table["equal"], table.index, s=60, color="black", label=f"over the same {tasks} tasks")
        axis.set_yticks(
            table.index, [f"{a} ({n} tasks)" for a, n in zip(table["algorithm"], table["own"], strict=True)]
        )
        axis.set_ylim(-0.6, len(table) - 0.4)
        axis.set(xlabel="mean normalised score", title="One row of averages, twice")
        figure.legend(loc="outside lower center", ncols=2, fontsize="small")
    write_table(path, table.iloc[::-1])
    return Path(path)


def gains_by_task(gains: pd.DataFrame, path: str | Path, *, title: str) -> Path:
    """How much higher one algorithm scores than another, a row per task and a marker for each source.

    Args:
        gains: rows of `task`, `source`, `gain`, and `low` and `high` where there are intervals.
        path: PNG to write; the numbers go beside it as CSV.
        title: over the plot.
    """
    tasks, sources = list(gains["task"].unique()), list(gains["source"].unique())
    markers, colours = ("o", "D", "s"), ("#000000", "#D55E00", "#0072B2")
    with drawing(path, (7.6, 0.3 * len(tasks) + 1.6)) as (figure, axes):
        axis = axes[0, 0]
        axis.axvline(0.0, color=COLOURS["threshold"], linewidth=1.2, zorder=1)
        for place, (source, marker, colour) in enumerate(zip(sources, markers, colours, strict=False)):
            here = gains[gains["source"] == source]
            rows = [len(tasks) - 1 - tasks.index(task) + 0.18 * (len(sources) - 1 - 2 * place) for task in here["task"]]
            if "low" in here:
                axis.hlines(rows, here["low"], here["high"], color=colour, linewidth=2.5, alpha=0.4)
            axis.scatter(here["gain"], rows, s=34, marker=marker, color=colour, label=source, zorder=3)
        axis.set_yticks(range(len(tasks)), tasks[::-1])
        axis.set_ylim(-0.6, len(tasks) - 0.4)
        axis.set(xlabel="difference in normalised score", title=title)
        figure.legend(loc="outside lower center", ncols=len(sources), fontsize="small")
    write_table(path, gains)
    return Path(path)


def runs_there(counts: pd.DataFrame, path: str | Path, *, planned: int) -> Path:
    """A map of how many seeds have a finished run, a row per task and a column per algorithm.

    Args:
        counts: (tasks, algorithms), named as the axes call them.
        path: PNG to write; the numbers go beside it as CSV.
        planned: seeds of each.
    """
    with drawing(path, (0.85 * counts.shape[1] + 2.4, 0.26 * len(counts) + 1.6)) as (_, axes):
        axis = axes[0, 0]
        axis.imshow(counts.to_numpy(), cmap="Greys", vmin=0, vmax=2.2 * planned, aspect="auto")
        for row, column in np.ndindex(counts.shape):
            number = counts.iat[row, column]
            axis.text(column, row, f"{number}" if number else "·", ha="center", va="center", fontsize="small")
        axis.set_xticks(range(counts.shape[1]), list(counts.columns), rotation=30, ha="right")
        axis.set_yticks(range(len(counts)), list(counts.index))
        axis.grid(visible=False)
        axis.set_title(f"Seeds that are finished, of {planned}")
    write_table(path, counts.rename_axis("task").reset_index())
    return Path(path)
