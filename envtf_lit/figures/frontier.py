"""The frontier of trust: what a world model promises of actors, by how far they have left the log."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from envtf_lit.figures.style import COLOURS, drawing, write_table


def frontiers(
    found: Mapping[str, pd.DataFrame],
    path: str | Path,
    *,
    quantity: str = "return of an episode",
    truths: Mapping[str, np.ndarray] | None = None,
) -> Path:
    """Promised returns against distance, a panel for each run; the actor that was published is ringed.

    Args:
        found: name to a policy's `frontier.csv`; its first row is the clone.
        path: PNG to write; the rows go beside it as CSV.
        quantity: what is promised, with its unit.
        truths: name to the returns (E,) that the published actor really had, where anyone knows.
    """
    with drawing(path, (3.6 * len(found) + 1.9, 3.6), 1, len(found)) as (figure, axes):
        for axis, (name, table) in zip(axes[0], found.items(), strict=True):
            if axis is not axes[0, 0]:
                axis.sharex(axes[0, 0])
                axis.sharey(axes[0, 0])
            _panel(axis, table, None if truths is None else truths.get(name))
            axis.set(title=name, xlabel="less likely than the clone\n(nats per action dimension)")
            axis.label_outer()
        axes[0, 0].set_ylabel(quantity)
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside right center", frameon=False)
        figure.suptitle("What is promised for leaving the log")
    write_table(path, pd.concat([table.assign(run=name) for name, table in found.items()]))
    return Path(path)


def _panel(axis: Axes, table: pd.DataFrame, truth: np.ndarray | None) -> None:
    x, y, error = (table[column].to_numpy() for column in ("excess", "promise", "error"))
    axis.errorbar(
        x, y, error, color=COLOURS["imagined"], marker="o", markersize=5, capsize=3, label="promised\n± standard error"
    )
    axis.plot(x[0], y[0], "o", color=COLOURS["recorded"], markersize=8, label="the clone")
    kept = int(table["kept"].to_numpy().argmax())
    ring = dict(markerfacecolor="none", markeredgecolor="black", markeredgewidth=1.8)
    axis.plot(x[kept], y[kept], "o", markersize=14, label="published", **ring)
    if truth is not None:
        mean, spread = truth.mean(), truth.std() / np.sqrt(len(truth))
        axis.errorbar(
            x[kept],
            mean,
            spread,
            color="#0072B2",
            marker="D",
            markersize=7,
            capsize=4,
            linestyle="none",
            label="in truth\n± standard error",
        )
