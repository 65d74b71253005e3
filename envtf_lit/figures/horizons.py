"""Plots of several world models' errors over long horizons, a panel per robot."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from envtf_lit.evaluation.horizon import THRESHOLDS
from envtf_lit.figures.style import COLOURS, Look, drawing, model_looks, write_table

LOWEST, HIGHEST = 1e-6, 1e2  # errors that are drawn
CEILING = "ceiling_typical"  # what median curves are to be compared with


def error_growth(curves: pd.DataFrame, run: str, path: str | Path) -> Path:
    """Median and quartiles of the nmse by step, a line per model; open loop with the physics ceiling beside them.

    Args:
        curves: rows of `robot`, `model`, `run`, `step`, `lower`, `median`, `upper`, `trajectories`; the ceiling is the
            run `ceiling_typical` of the first model, whose one-step error disturbed the start.
        run: `open_loop` or `teacher_forced`.
        path: PNG to write; the numbers go beside it as CSV.
    """
    shown = curves.query("run == @run")
    if run == "open_loop":
        shown = pd.concat([shown, curves.query("run == @CEILING and model == model.iloc[0]")])
    robots, looks = shown["robot"].unique(), model_looks(shown["model"].unique())
    with drawing(path, _size(len(robots), 3.7), 1, len(robots)) as (figure, axes):
        for axis, robot in zip(axes.flat, robots, strict=True):
            _panel(axis, shown.query("robot == @robot"), looks)
            axis.set(title=robot, xlabel="step h")
        axes[0, 0].set_ylabel("normalised squared error")
        _legend(axes[0, -1], axes)
        words = "open loop, fed its own predictions" if run == "open_loop" else "teacher-forced, shown the true past"
        figure.suptitle(f"Error on recorded actions:\n{words} (median, quartiles)")
    write_table(path, shown)
    return Path(path)


def online_growth(curves: pd.DataFrame, path: str | Path) -> Path:
    """The open-loop errors along the actions of policies that drive MuJoCo: a row per policy, a column per robot.

    A panel stays empty where a robot has no episode of a policy.
    """
    shown = curves.query("run == 'open_loop'")
    robots, policies, looks = shown["robot"].unique(), shown["source"].unique(), model_looks(shown["model"].unique())
    with drawing(path, _size(len(robots), 2.6 * len(policies)), len(policies), len(robots)) as (figure, axes):
        for row, policy in zip(axes, policies, strict=True):
            for axis, robot in zip(row, robots, strict=True):
                if (lines := shown.query("robot == @robot and source == @policy")).empty:
                    axis.set_axis_off()
                    continue
                _panel(axis, lines, looks)
                axis.set_title(f"{robot}, {policy} policy", fontsize="medium")
            row[0].set_ylabel("normalised squared error")
        for axis in axes[-1]:
            axis.set_xlabel("step h")
        _legend(next(axis for axis in axes[:, -1] if axis.lines), axes)
        figure.suptitle("Error on the actions of policies that drive MuJoCo:\nopen loop (median, quartiles)")
    write_table(path, shown)
    return Path(path)


def steps_against_ceiling(lengths: pd.DataFrame, path: str | Path) -> Path:
    """Open-loop steps against the one-step error, with what physics itself reaches when its start is off by as much.

    Args:
        lengths: rows of `robot`, `model` (`physics` for the ceiling), `threshold`, `error`, `steps`, `standard_error`.
        path: PNG to write; the numbers go beside it as CSV.
    """
    robots, looks = lengths["robot"].unique(), model_looks(lengths["model"].unique())
    with drawing(path, _size(len(robots), 2.7 * len(THRESHOLDS)), len(THRESHOLDS), len(robots)) as (figure, axes):
        for row, threshold in zip(axes, THRESHOLDS, strict=True):
            for axis, robot in zip(row, robots, strict=True):
                here = lengths.query("robot == @robot and threshold == @threshold")
                for model, points in here.groupby("model", sort=False):
                    look, physics = looks[str(model)], model == "physics"
                    axis.errorbar(
                        points["error"],
                        points["steps"],
                        points["standard_error"],
                        color=look.colour,
                        label=look.label,
                        capsize=3,
                        marker="." if physics else look.marker,
                        linestyle="--" if physics else "",
                    )
                axis.set(xscale="log", title=f"{robot}, within {threshold:g}")
                axis.set_ylim(bottom=0)
            row[0].set_ylabel("steps")
        for axis in axes[-1]:
            axis.set_xlabel("typical one-step error (std)")
        _legend(axes[0, -1], axes)
        figure.suptitle(
            "Steps within a threshold, open loop, and what\nphysics reaches if its start is off by the same error"
        )
    write_table(path, lengths)
    return Path(path)


def _size(columns: int, height: float) -> tuple[float, float]:
    """Inches of a figure, with room for the legend and two lines of title."""
    return 3.2 * columns + 2.0, height + 0.9


def _panel(axis: Axes, curves: pd.DataFrame, looks: dict[str, Look]) -> None:
    """Lines of every model, on logarithmic axes, with the thresholds."""
    for name, line in curves.query("run != @CEILING").groupby("model", sort=False):
        look = looks[str(name)]
        axis.fill_between(line["step"], line["lower"], line["upper"], color=look.colour, alpha=0.15, lw=0)
        axis.plot(line["step"], line["median"], color=look.colour, linestyle=look.line, label=look.label)
    for name, line in curves.query("run == @CEILING").groupby("model", sort=False):
        line = line[line["median"] <= max(THRESHOLDS)]  # replays end there
        label = f"physics, off as\n{looks[str(name)].label}"
        axis.plot(line["step"], line["median"], color=COLOURS["physics"], linestyle=":", zorder=3, label=label)
    for threshold in THRESHOLDS:
        axis.axhline(threshold, color=COLOURS["threshold"], linestyle="--", linewidth=1.0, zorder=1)
    axis.set(xscale="log", yscale="log")
    axis.xaxis.set_major_formatter("{x:g}")
    low, high = axis.get_ylim()
    axis.set_ylim(max(low, LOWEST), min(high, HIGHEST))


def _legend(axis: Axes, axes: np.ndarray) -> None:
    """Beside one axis, of all that any of the axes shows: robots need not have the same models."""
    shown = {label: line for each in axes.flat for line, label in zip(*each.get_legend_handles_labels(), strict=True)}
    axis.legend(shown.values(), shown.keys(), fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
