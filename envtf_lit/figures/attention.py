"""Plots of attention: a map for each head, and how far back each looks."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.ticker import MaxNLocator

from envtf_lit.figures.style import LINES, POLICY_COLOURS, drawing, write_table

DARK = "Greys"  # of weights: the darker, the more


def attention_maps(weights: np.ndarray, path: str | Path, *, title: str = "What each step looks at") -> Path:
    """A map for each layer (rows) and head (columns): how much the step of a row mixes in of the step of a column.

    Args:
        weights: (L, H, T, T), in [0, 1].
        path: PNG to write.
        title: over all of them.
    """
    layers, heads = weights.shape[:2]
    most = weights[:, :, weights.shape[-1] // 3 :].max()  # the first steps have little to choose from
    with drawing(path, (1.95 * heads + 1.5, 1.95 * layers + 1.1), layers, heads) as (figure, axes):
        image = None
        for layer, row in enumerate(axes):
            for head, axis in enumerate(row):
                image = axis.imshow(weights[layer, head], vmin=0, vmax=most, cmap=DARK)
                axis.grid(visible=False)
                axis.set_title(f"layer {layer + 1}, head {head + 1}", fontsize="medium")
                axis.label_outer()
            row[0].set_ylabel("looking (step)")
        for axis in axes[-1]:
            axis.set_xlabel("looked at (step)")
        if image is not None:
            figure.colorbar(image, ax=axes, label="weight", shrink=0.8, extend="max")
        figure.suptitle(title)
    return Path(path)


def steps_back(weights: np.ndarray, path: str | Path) -> Path:
    """How far back each head looks: a panel for each layer, a line for each head, the even share dotted.

    Args:
        weights: (L, H, C) mean weight on the step 0 … C - 1 steps back, of a context of C.
        path: PNG to write; the numbers go beside it as CSV.
    """
    layers, heads, context = weights.shape
    with drawing(path, (3.6 * layers + 1.2, 3.3), 1, layers) as (_, axes):
        for layer, axis in enumerate(axes.flat):
            for head in range(heads):
                line, marker = LINES[head % len(LINES)]
                look = dict(color=POLICY_COLOURS[head % len(POLICY_COLOURS)], linestyle=line, marker=marker)
                axis.plot(range(context), weights[layer, head], markersize=4, label=f"head {head + 1}", **look)
            axis.axhline(1 / context, color="gray", linestyle=":", linewidth=1.2, label="an even share")
            axis.set(title=f"layer {layer + 1}", xlabel="steps back")
            axis.set_ylim(0, 1.08 * max(weights.max(), 1 / context))
            axis.xaxis.set_major_locator(MaxNLocator(6, integer=True))
            axis.label_outer()
        axes[0, 0].set_ylabel("mean weight")
        axes[0, -1].legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    grid = np.indices(weights.shape).reshape(3, -1)
    write_table(
        path, pd.DataFrame(dict(zip(("layer", "head", "steps_back"), grid, strict=True), weight=weights.ravel()))
    )
    return Path(path)


def small_matrices(matrices: Sequence[tuple[str, np.ndarray]], path: str | Path, *, ticks: Sequence[str]) -> Path:
    """Small matrices with their numbers written in, side by side; what is minus infinity stays empty.

    Args:
        matrices: title and (T, T) each.
        path: PNG to write.
        ticks: (T,) what to call the rows and columns.
    """
    with drawing(path, (2.7 * len(matrices), 2.9), 1, len(matrices)) as (_, axes):
        for axis, (title, matrix) in zip(axes.flat, matrices, strict=True):
            shown = np.where(np.isfinite(matrix), matrix, np.nan)
            low, high = np.nanmin(shown), np.nanmax(shown)
            axis.imshow(shown, cmap=DARK, vmin=low, vmax=high + 1e-9)
            axis.grid(visible=False)
            for (i, j), value in np.ndenumerate(shown):
                text = "" if np.isnan(value) else f"{value:.2f}"
                colour = "white" if value > 0.4 * low + 0.6 * high else "black"
                axis.text(j, i, text, ha="center", va="center", fontsize="small", color=colour)
            axis.set_xticks(range(len(ticks)), ticks)
            axis.set_yticks(range(len(ticks)), ticks)
            axis.set_title(title, fontsize="medium")
    return Path(path)
