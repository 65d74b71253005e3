"""Plots of episodes: what the dataset holds and what the policies reach."""

from collections.abc import Mapping
from pathlib import Path
from textwrap import fill

import numpy as np
import pandas as pd
import seaborn as sns
from matplotlib.ticker import MaxNLocator

from envtf_lit.figures.style import COLOURS, LABELS, drawing, policy_colours, write_table

GOLDEN = 0.618033988749895


def score_strip(
    references: Mapping[str, np.ndarray],
    policies: Mapping[str, np.ndarray],
    path: str | Path,
    *,
    labels: Mapping[str, str] | None = None,
    quantity: str = "normalised score\n(0 random, 100 D4RL's expert)",
    title: str = "Score of every episode",
) -> Path:
    """Every episode's score as a dot, with mean and standard deviation.

    Args:
        references: what policies are compared with, such as `data` (see `COLOURS`), to scores (E,) of episodes.
        policies: names of policies to scores (E,) of episodes.
        path: PNG to write; the numbers go beside it as CSV.
        labels: what to call each policy.
        quantity: what a score is, with its unit.
        title: over all of them.
    """
    known, colours = labels or {}, policy_colours(policies)
    columns = [(LABELS[name], COLOURS[name], scores) for name, scores in references.items()]
    columns += [(_wrapped(known.get(name, name)), colours[name], scores) for name, scores in policies.items()]
    with drawing(path, (1.7 * len(columns) + 1.6, 4.6)) as (_, axes):
        axis = axes[0, 0]
        for place, (_, colour, values) in enumerate(columns):
            # spread sideways by multiples of the golden ratio: even, and the same every time
            offsets = 0.5 * ((GOLDEN * np.arange(len(values))) % 1.0 - 0.5)
            size, opacity = (9, 0.35) if len(values) > 100 else (26, 0.6)
            axis.scatter(place + offsets, values, s=size, color=colour, alpha=opacity, linewidths=0, zorder=2)
            axis.errorbar(place + 0.36, values.mean(), values.std(), color="black", marker="D", markersize=5, capsize=4)
            note = f"{values.mean():.1f} ± {values.std():.1f}"
            axis.annotate(note, (place, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 4),
                          textcoords="offset points", ha="center", fontsize="small")  # fmt: skip
        axis.set_xticks(range(len(columns)), [label for label, _, _ in columns])
        axis.set_xlim(-0.5, len(columns) - 0.4)
        axis.grid(visible=False, axis="x")
        axis.set_ylabel(quantity)
        axis.set_title(f"{title}, with mean ± standard deviation", pad=22)
    parts = [
        pd.DataFrame({"kind": kind, "name": name, "episode": range(len(scores)), "score": scores})
        for kind, group in (("reference", references), ("policy", policies))
        for name, scores in group.items()
    ]
    write_table(path, pd.concat(parts))
    return Path(path)


def _wrapped(label: str) -> str:
    """A label in lines short enough to stand beside the next one."""
    return fill(label, 15, break_long_words=True, break_on_hyphens=False)


def returns_histogram(returns: np.ndarray, lengths: np.ndarray, path: str | Path) -> Path:
    """Histograms of the returns and the lengths of the dataset's episodes, given as (E,) each."""
    with drawing(path, (9.0, 3.6), 1, 2) as (figure, axes):
        for axis, values, label in zip(axes.flat, (returns, lengths), ("return", "length (steps)"), strict=True):
            sns.histplot(x=values, bins=40, ax=axis, color=COLOURS["data"])
            mean = values.mean()
            axis.axvline(mean, color="black", linestyle="--", linewidth=1.2, label=f"mean {mean:.0f}")
            axis.set(xlabel=f"episode {label}", ylabel="episodes")
            axis.yaxis.set_major_locator(_whole_ticks())
            axis.legend()
        axes[0, 1].xaxis.set_major_locator(_whole_ticks())
        figure.suptitle(f"The dataset's {len(returns):,} episodes")
    write_table(path, pd.DataFrame({"return": returns, "length": lengths}))
    return Path(path)


def _whole_ticks() -> MaxNLocator:
    """Ticks of what is counted."""
    return MaxNLocator("auto", integer=True, steps=[1, 2, 5, 10], min_n_ticks=1)
