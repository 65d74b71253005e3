"""Plots of episodes: what the dataset holds and what the policies reach."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import seaborn as sns

from envtf_lit.figures.style import COLOURS, LABELS, drawing, policy_colours, write_table

GOLDEN = 0.618033988749895


def score_strip(
    scores: Mapping[str, np.ndarray],
    path: str | Path,
    *,
    labels: Mapping[str, str] | None = None,
    quantity: str = "normalised score\n(0 random, 100 D4RL's expert)",
    title: str = "Score of every episode",
) -> Path:
    """Every episode's score as a dot, with mean and standard deviation.

    Args:
        scores: names of policies, and of what they are compared with such as `data`, to scores (E,) of episodes.
        path: PNG to write; the numbers go beside it as CSV.
        labels: what to call each policy.
        quantity: what a score is, with its unit.
        title: over all of them.
    """
    labels = labels or {}
    colours = COLOURS | policy_colours(name for name in scores if name not in COLOURS)
    with drawing(path, (1.9 * len(scores) + 1.2, 4.6)) as (_, axes):
        axis = axes[0, 0]
        for place, (name, values) in enumerate(scores.items()):
            # spread sideways by multiples of the golden ratio: even, and the same every time
            offsets = 0.5 * ((GOLDEN * np.arange(len(values))) % 1.0 - 0.5)
            size, opacity = (9, 0.35) if len(values) > 100 else (26, 0.6)
            axis.scatter(place + offsets, values, s=size, color=colours[name], alpha=opacity, linewidths=0, zorder=2)
            axis.errorbar(place + 0.36, values.mean(), values.std(), color="black", marker="D", markersize=5, capsize=4)
            note = f"{values.mean():.1f} ± {values.std():.1f}"
            axis.annotate(note, (place, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 4),
                          textcoords="offset points", ha="center", fontsize="small")  # fmt: skip
        axis.set_xticks(range(len(scores)), [({**LABELS, **labels}).get(name, name) for name in scores])
        axis.set_xlim(-0.5, len(scores) - 0.4)
        axis.grid(visible=False, axis="x")
        axis.set_ylabel(quantity)
        axis.set_title(f"{title}, with mean ± standard deviation", pad=22)
    parts = [pd.DataFrame({"policy": name, "episode": range(len(v)), "score": v}) for name, v in scores.items()]
    write_table(path, pd.concat(parts))
    return Path(path)


def returns_histogram(returns: np.ndarray, lengths: np.ndarray, path: str | Path) -> Path:
    """Histograms of the returns and the lengths of the dataset's episodes, given as (E,) each."""
    with drawing(path, (9.0, 3.6), 1, 2) as (figure, axes):
        for axis, values, label in zip(axes.flat, (returns, lengths), ("return", "length (steps)"), strict=True):
            sns.histplot(x=values, bins=40, ax=axis, color=COLOURS["data"])
            mean = values.mean()
            axis.axvline(mean, color="black", linestyle="--", linewidth=1.2, label=f"mean {mean:.0f}")
            axis.set(xlabel=f"episode {label}", ylabel="episodes")
            axis.legend()
        figure.suptitle(f"The dataset's {len(returns):,} episodes")
    write_table(path, pd.DataFrame({"return": returns, "length": lengths}))
    return Path(path)
