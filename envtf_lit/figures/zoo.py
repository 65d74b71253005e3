"""The scores of all datasets of a folder, side by side."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from envtf_lit.data.cards import distribution
from envtf_lit.figures.style import drawing, write_table
from envtf_lit.robots.tasks import TIERS, get_task

BINS = 60
TIER_COLOURS: dict[str, str] = dict(zip(TIERS, ("#8c8c8c", "#0072B2", "#56B4E9", "#D55E00", "#009E73"), strict=True))


def score_distributions(scores: Mapping[str, np.ndarray], path: str | Path) -> Path:
    """A panel per robot, in it a histogram of episodes per dataset, scaled to its highest bin, with a line at its mean.

    Args:
        scores: the datasets' names to the D4RL-normalised scores (E,) of their episodes.
        path: PNG to write; mean, spread and quantiles go beside it as CSV.
    """
    robots: dict[str, list[str]] = {}
    for name in scores:
        robots.setdefault(get_task(name).robot.name, []).append(name)
    tallest = max(map(len, robots.values()))
    with drawing(path, (3.6 * len(robots) + 0.6, 0.85 * tallest + 1.3), 1, len(robots)) as (figure, axes):
        for axis, (robot, names) in zip(axes.flat, robots.items(), strict=True):
            everything = np.concatenate([scores[name] for name in names])
            edges = np.linspace(everything.min(), everything.max() + 1e-6, BINS + 1)
            for place, name in enumerate(reversed(names)):
                counts, _ = np.histogram(scores[name], edges)
                colour = TIER_COLOURS[get_task(name).tier]
                axis.stairs(place + 0.85 * counts / counts.max(), edges, baseline=place, fill=True, color=colour)
                mean = float(scores[name].mean())
                axis.plot([mean, mean], [place, place + 0.85], color="black", linewidth=1.2)
                axis.annotate(str(round(mean)), (mean, place + 0.86), ha="center", va="bottom", fontsize="x-small")
            labels = [name.removeprefix(f"{robot}-") for name in reversed(names)]
            axis.set_yticks(np.arange(len(names)) + 0.3, labels)
            axis.set_ylim(0, len(names) + 0.15)
            axis.grid(visible=False, axis="y")
            axis.set(title=robot, xlabel="normalised score")
        figure.suptitle("Scores of the episodes, with their mean")
    write_table(path, _table(scores))
    return Path(path)


def _table(scores: Mapping[str, np.ndarray]) -> pd.DataFrame:
    return pd.DataFrame(
        {"task": name, "episodes": len(values)} | distribution(values) for name, values in scores.items()
    )
