"""Plots and tables of logs: their rows, how episodes end, where they have been, and what was guessed from them."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.colors import LogNorm

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.evaluation.coverage import Visits
from envtf_lit.figures.style import LINES, drawing, featured, observation_labels, write_table
from envtf_lit.figures.zoo import TIER_COLOURS

SEEN = "viridis"  # of counts: dark to bright, in greyscale too


def rows_table(dataset: OfflineDataset, robot: str | None, rows: range) -> pd.DataFrame:
    """Some rows as text: four dimensions of the observation, the first of the action, the reward and the flags."""
    labels = observation_labels(robot, dataset.observation_dim)
    columns: dict[str, object] = {"row": list(rows), "episode": dataset.episode_index[rows]}
    columns |= {labels[i]: _text(dataset.observations[rows, i]) for i in featured(dataset.observation_dim)}
    columns |= {"action 0": _text(dataset.actions[rows, 0]), "reward": _text(dataset.rewards[rows])}
    flags = {"terminated": dataset.terminated[rows], "truncated": dataset.truncated[rows]}
    return pd.DataFrame(columns | {name: np.where(flag, "yes", "") for name, flag in flags.items()})


def _text(values: np.ndarray) -> list[str]:
    return [f"{value:.2f}" for value in values]


def logs_table(logs: Mapping[str, OfflineDataset]) -> pd.DataFrame:
    """Rows, episodes, how they end, and their length and return, a line for each log."""
    return pd.DataFrame(
        {
            "log": name,
            "rows": f"{len(log):,}",
            "episodes": f"{len(log.episode_starts):,}",
            "terminated": f"{log.terminated.sum():,}",
            "truncated": f"{(log.truncated & ~log.terminated).sum():,}",
            "mean length (steps)": f"{log.episode_lengths.mean():.0f}",
            "mean return": f"{log.episode_returns.mean():,.0f}",
            "best return": f"{log.episode_returns.max():,.0f}",
        }
        for name, log in logs.items()
    )


def coverage_maps(found: Visits, robot: str | None, observation_dim: int, path: str | Path) -> Path:
    """Where in two dimensions each log has been: rows per cell, and above each map its share of all cells visited.

    Args:
        found: the counts.
        robot: gives the dimensions their names and units; None where it is not ours.
        observation_dim: of the logs.
        path: PNG to write; the shares go beside it as CSV.
    """
    labels = observation_labels(robot, observation_dim)
    most = max(count.max() for count in found.counts.values())
    with drawing(path, (2.5 * len(found.counts) + 1.0, 3.2), 1, len(found.counts)) as (figure, axes):
        image = None
        for axis, (name, count) in zip(axes.flat, found.counts.items(), strict=True):
            shown = np.where(count > 0, count, np.nan).T
            image = axis.pcolormesh(found.x_edges, found.y_edges, shown, norm=LogNorm(1, most), cmap=SEEN)
            axis.set_title(f"{name}\n{found.share(name):.0%} of the cells", fontsize="medium")
            axis.set_xlabel(labels[found.dimensions[0]])
            axis.label_outer()
        axes[0, 0].set_ylabel(labels[found.dimensions[1]])
        if image is not None:
            figure.colorbar(image, ax=axes, label="rows in a cell", pad=0.01)
    write_table(path, pd.DataFrame({"log": [*found.counts], "share": [found.share(name) for name in found.counts]}))
    return Path(path)


def quality_and_coverage(scores: Mapping[str, np.ndarray], shares: Mapping[str, float], path: str | Path) -> Path:
    """How good the episodes of each tier are against how much it has seen.

    Args:
        scores: tier to the scores (E,) of its episodes, of which the mean and the middle 80 % are drawn.
        shares: tier to its share of the cells that any of them visits.
        path: PNG to write; the numbers go beside it as CSV.
    """
    rows = []
    with drawing(path, (6.4, 3.8)) as (_, axes):
        axis = axes[0, 0]
        for (tier, values), (_, marker) in zip(scores.items(), (*LINES, ("-", "v")), strict=False):
            low, high = np.quantile(values, (0.1, 0.9))
            axis.plot([100 * shares[tier]] * 2, [low, high], color=TIER_COLOURS[tier], linewidth=1.6)
            axis.plot(100 * shares[tier], values.mean(), marker, color=TIER_COLOURS[tier], markersize=9, label=tier)
            rows.append((tier, shares[tier], values.mean(), low, high))
        axis.set(xlabel="cells visited (% of those that any tier visits)", xlim=(0, 100))
        axis.set_ylabel("normalised score\n(mean, middle 80 % of episodes)")
        axis.set_title("What a tier knows, and how well it acts")
        axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    write_table(path, pd.DataFrame(rows, columns=["tier", "share", "mean", "quantile_0.1", "quantile_0.9"]))
    return Path(path)


def guesses(found: Mapping[str, tuple[np.ndarray, np.ndarray]], quantity: str, path: str | Path) -> Path:
    """Guesses against the truth, a panel for each way of guessing, with their correlation.

    Args:
        found: name to the truth (Q,) and what was guessed (Q,).
        quantity: what was guessed, with its unit.
        path: PNG to write; all points go beside it as CSV.
    """
    everything = np.concatenate([np.concatenate(pair) for pair in found.values()])
    ends = [everything.min(), everything.max()]
    with drawing(path, (4.0 * len(found) + 0.4, 3.9), 1, len(found)) as (_, axes):
        for axis, (name, (truth, guess)) in zip(axes.flat, found.items(), strict=True):
            axis.plot(ends, ends, color="black", linewidth=0.8)
            axis.scatter(truth, guess, s=14, alpha=0.5, linewidths=0, color="#0072B2", zorder=2)
            axis.set(xlabel=f"true {quantity}", aspect="equal")
            axis.set_title(f"{name}\ncorrelation {agreement(truth, guess):.2f}", fontsize="medium")
        axes[0, 0].set_ylabel(f"guessed {quantity}")
    table = [pd.DataFrame({"way": name, "truth": pair[0], "guess": pair[1]}) for name, pair in found.items()]
    write_table(path, pd.concat(table))
    return Path(path)


def agreement(truth: np.ndarray, guess: np.ndarray) -> float:
    """Pearson's correlation of two columns (Q,), 0 where either is constant."""
    if min(truth.std(), guess.std()) == 0:
        return 0.0
    return float(np.corrcoef(truth, guess)[0, 1])
