"""Learning curves, read from a model folder's curves.csv whatever columns it holds."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from envtf_lit.figures.style import COLOURS, drawing, policy_colours, write_table

CLOCKS = ("update", "updates", "step", "epoch")  # columns that count progress rather than measure something
TITLES = {
    "loss": "loss",
    "open_loop_error": "open-loop nmse",
    "q_data": "Q at the data's actions",
    "q_policy": "Q at the policy's actions",
    "q_target": "TD target",
    "conservative_gap": "conservative gap",
    "bellman_loss": "Bellman loss",
    "critic_loss": "critic loss",
    "warm_critic_loss": "critic loss, warm start",
    "clone_loss": "-log density of real actions",
    "actor_loss": "actor loss",
    "imagined_value": "imagined return, through the model",
    "trust_weight": "weight of the clone loss",
    "cut_share": "share of imagined paths that were cut",
    "value_loss": "state value loss",
    "entropy": "entropy of the policy (nats)",
    "alpha": "temperature alpha",
    "weight": "weight of a cloned row",
    "model_loss": "world model's own loss",
    "adversarial_loss": "world model's adversarial loss",
    "value": "state value",
    "warm_value_loss": "state value loss, warm start",
    "weighted_clone_loss": "weighted -log density of real actions",
}
MOST_PANELS = 12


def tidy_curves(runs: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Curves of several runs as rows (run, split, quantity, clock, at, value); empty cells are dropped.

    A column `train/loss` has split `train` and quantity `loss`; a column without a slash has split `train`.
    """
    parts = []
    for run, curves in runs.items():
        clock = next((name for name in CLOCKS if name in curves.columns), None)
        at = curves[clock] if clock is not None else pd.Series(range(len(curves)))
        for column in curves.columns.difference(CLOCKS, sort=False):
            values = pd.to_numeric(curves[column], errors="coerce")
            split, _, quantity = column.rpartition("/")
            rows = {"split": split or "train", "quantity": quantity, "clock": clock or "row", "at": at, "value": values}
            parts.append(pd.DataFrame({"run": run, **rows}).dropna())
    return pd.concat(parts, ignore_index=True)


def learning_curves(
    runs: Mapping[str, pd.DataFrame], path: str | Path, *, title: str, labels: Mapping[str, str] | None = None
) -> Path:
    """One panel per quantity that was logged more than once, one line per run; validation is dashed.

    Args:
        runs: name of the run, such as a policy's, to its curves.csv.
        path: PNG to write; the numbers go beside it as CSV.
        title: over all panels.
        labels: what to call each run.
    """
    table = tidy_curves(runs)
    order = list(TITLES)
    known = sorted(table["quantity"].unique(), key=lambda name: order.index(name) if name in TITLES else len(order))
    curves = [name for name in known if table.loc[table["quantity"] == name, "at"].nunique() > 1]
    quantities = (curves or known)[:MOST_PANELS]  # one point is no curve, and stays in the CSV
    rows, columns = _grid(len(quantities))
    longest = max(len(name) for name in (labels or {}).values() or runs)
    across = max(1, int(4.2 * columns / (0.6 + 0.09 * longest)))  # legend entries side by side, by their inches
    height = 2.9 * rows + 0.4 + 0.22 * math.ceil(len(runs) / across)
    with drawing(path, (4.2 * columns, height), rows, columns) as (figure, axes):
        for axis, quantity in zip(axes.flat, quantities, strict=False):
            _panel(axis, table.loc[table["quantity"] == quantity, :], quantity, labels or {}, tuple(runs))
        figure.suptitle(title)
        lines = {line.get_label(): line for axis in axes.flat for line in axis.get_lines()}
        ordered = [label for label in (labels or {}).values() if label in lines]
        entries = {label: lines[label] for label in [*ordered, *lines]}
        _legend(figure, list(axes.flat)[len(quantities) :], entries, across)
    write_table(path, table)
    return Path(path)


def _grid(panels: int) -> tuple[int, int]:
    """Rows and columns, three or four of the latter, that leave the fewest places empty."""
    columns = min(panels, min((3, 4), key=lambda width: -panels % width))
    return math.ceil(panels / columns), columns


def _legend(figure: Figure, empty: list[Axes], lines: Mapping[Any, Artist], across: int) -> None:
    """The legend of all panels, in the first empty place where there is one."""
    for axis in empty:
        axis.set_axis_off()
    if empty:
        empty[0].legend(lines.values(), lines.keys(), loc="center")
    else:
        figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=min(len(lines), across))


def _panel(axis: Axes, lines: pd.DataFrame, quantity: str, labels: Mapping[str, str], runs: tuple[str, ...]) -> None:
    single, colours = len(runs) == 1, policy_colours(runs)
    for run, split in dict.fromkeys(zip(lines["run"], lines["split"], strict=True)):
        line = lines[(lines["run"] == run) & (lines["split"] == split)]
        validated = split != "train"
        label = ("held out" if validated else "training") if single else labels.get(str(run), str(run))
        colour = COLOURS["imagined" if validated else "recorded"] if single else colours[str(run)]
        axis.plot(
            line["at"], line["value"], color=colour, linestyle="--" if validated else "-", label=label, marker="."
        )
    values = lines["value"].to_numpy()
    if values.min() > 0 and values.max() > 30 * values.min():
        axis.set_yscale("log")
    axis.set(title=TITLES.get(quantity, quantity.replace("_", " ")), xlabel=lines["clock"].iloc[0])
    axis.xaxis.set_major_locator(MaxNLocator(6, integer=True))
