"""Pictures of a point on a plane: where it goes, and what critics believe of each thing it could do."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.colors import TwoSlopeNorm
from matplotlib.patches import Rectangle

from envtf_lit.figures.style import COLOURS, drawing, policy_colours, write_table

BELIEF = "RdBu_r"  # of Q about 0: what is red cannot be


def paths_on_plane(
    log: np.ndarray,
    found: Mapping[str, np.ndarray],
    path: str | Path,
    *,
    goal: tuple[float, float],
    block: float,
    title: str,
) -> Path:
    """Paths over the states of a log.

    Args:
        log: (N, 2) the recorded states.
        found: name to paths (E, T + 1, 2).
        path: PNG to write; the paths go beside it as CSV.
        goal: where to.
        block: half the side of the square that nobody enters.
        title: over all of them.
    """
    colours = policy_colours(found)
    with drawing(path, (3.1 * len(found) + 0.6, 3.5), 1, len(found)) as (figure, axes):
        for axis, (name, paths) in zip(axes[0], found.items(), strict=True):
            axis.scatter(*log.T, s=4, color=COLOURS["data"], alpha=0.25, linewidths=0, label="the log")
            axis.add_patch(
                Rectangle((-block, -block), 2 * block, 2 * block, facecolor="0.85", edgecolor="0.5", hatch="//")
            )
            for line in paths:
                axis.plot(*line.T, color=colours[name], linewidth=1.6)
            axis.plot(*goal, "*", color="black", markersize=13)
            axis.set(title=name, xlim=(-1.05, 1.05), ylim=(-1.05, 1.05), aspect="equal", xlabel="x")
            axis.label_outer()
        axes[0, 0].set_ylabel("y")
        figure.suptitle(title)
    tables = (
        pd.DataFrame({"who": name, "episode": number, "x": line[:, 0], "y": line[:, 1]})
        for name, paths in found.items()
        for number, line in enumerate(paths)
    )
    write_table(path, pd.concat(tables))
    return Path(path)


def belief_maps(found: Mapping[str, np.ndarray], recorded: np.ndarray, path: str | Path, *, title: str) -> Path:
    """What critics believe in one state of all actions, a map each; red is above 0, which cannot be.

    Args:
        found: name to Q (bins, bins) over [-1, 1]², the action's first dimension first.
        recorded: (N, 2) actions of the log near that state.
        path: PNG to write; the maps go beside it as CSV.
        title: over all of them.
    """
    with drawing(path, (4.0 * len(found) + 0.4, 3.7), 1, len(found)) as (figure, axes):
        for axis, (name, q) in zip(axes[0], found.items(), strict=True):
            most = max(float(np.abs(q).max()), 1e-6)
            image = axis.imshow(
                q.T, origin="lower", extent=(-1, 1, -1, 1), cmap=BELIEF, norm=TwoSlopeNorm(0.0, -most, most)
            )
            axis.scatter(*recorded.T, s=12, facecolors="none", edgecolors="black", linewidths=0.7)
            best = np.unravel_index(int(q.argmax()), q.shape)
            place = -1 + 2 * np.array(best) / (len(q) - 1)
            axis.plot(*place, "X", color="#F0E442", markeredgecolor="black", markersize=11, clip_on=False)
            axis.set(title=f"{name}\nbest: {q.max():.3g}", xlabel="action in x")
            axis.grid(visible=False)
            axis.label_outer()
            figure.colorbar(image, ax=axis, label="Q (return to come)", shrink=0.85)
        axes[0, 0].set_ylabel("action in y")
        figure.suptitle(title)
    write_table(path, pd.concat(pd.DataFrame({"who": name, "q": q.ravel()}) for name, q in found.items()))
    return Path(path)
