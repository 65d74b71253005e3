"""Plots of calibration: coverage, ROC curves and errors along rollouts, a row of panels per robot."""

from collections.abc import Mapping
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter

from envtf_lit.figures.style import Look, drawing, model_looks, write_table

Columns = Mapping[str, list[float]]
TITLES = {
    "coverage": "held-out outcomes in intervals",
    "roc_expert": "the expert's states",
    "roc_random_policy": "a random policy's states",
    "roc_random_action": "random actions",
    "errors": "error along own rollouts",
}
AXES = {
    "coverage": ("nominal", "observed", "nominal share", "observed share"),
    "errors": ("uncertainty", "median", "uncertainty u (std)", "true error (std)"),
}
ROC = ("false", "true", "false positive rate", "true positive rate")


def calibration_page(curves: Mapping[str, Mapping[str, Mapping[str, Columns]]], path: str | Path) -> Path:
    """Coverage, three ROC curves, and true error against predicted uncertainty (median, quartiles).

    Args:
        curves: by robot, model and panel, as `envtf_lit.studies.calibration` measures them; a model may lack some.
        path: PNG to write; the numbers go beside it as CSV.
    """
    looks = model_looks(dict.fromkeys(model for models in curves.values() for model in models))
    with drawing(path, (3.1 * len(TITLES), 2.9 * len(curves) + 0.5), len(curves), len(TITLES)) as (figure, axes):
        for row, (robot, models) in zip(axes, curves.items(), strict=True):
            for axis, kind in zip(row, TITLES, strict=True):
                _panel(axis, kind, {model: panels[kind] for model, panels in models.items() if kind in panels}, looks)
            row[0].set_ylabel(f"{robot}\n{row[0].get_ylabel()}")
        for axis, title in zip(axes[0], TITLES.values(), strict=True):
            axis.set_title(title, fontsize="medium")
        axes[0, 2].legend(loc="lower right", fontsize="small")  # where curves run along the top
        figure.suptitle("Does the model know what it does not know?")
    write_table(path, _long(curves))
    return Path(path)


def _panel(axis: Axes, kind: str, models: Mapping[str, Columns], looks: Mapping[str, Look]) -> None:
    x, y, xlabel, ylabel = AXES.get(kind, ROC)
    for model, columns in models.items():
        look = looks[model]
        axis.plot(columns[x], columns[y], color=look.colour, linestyle=look.line, label=look.label, linewidth=1.8)
        if kind == "errors":
            axis.fill_between(columns[x], columns["lower"], columns["upper"], color=look.colour, alpha=0.2, lw=0)
    axis.set(xlabel=xlabel, ylabel=ylabel)
    if kind == "errors":
        axis.set(xscale="log", yscale="log")
        for scale in (axis.xaxis, axis.yaxis):
            scale.set_major_locator(LogLocator(subs=(1.0, 3.0)))
            scale.set_major_formatter("{x:g}")
            scale.set_minor_formatter(NullFormatter())
        return
    axis.plot([0, 1], [0, 1], color="black", linewidth=0.8, linestyle="-" if kind == "coverage" else ":")
    axis.set(xlim=(0, 1), ylim=(0, 1.01), aspect="equal")


def _long(curves: Mapping[str, Mapping[str, Mapping[str, Columns]]]) -> pd.DataFrame:
    """One row per robot, model, panel and point."""
    return pd.concat(
        pd.DataFrame(dict(columns)).assign(robot=robot, model=model, panel=kind)
        for robot, models in curves.items()
        for model, panels in models.items()
        for kind, columns in panels.items()
    )
