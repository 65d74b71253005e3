"""Plots of what a model knows: on a line, against the errors that came, over a map, and along rollouts."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axis import Axis
from matplotlib.colors import LogNorm
from matplotlib.ticker import LogLocator, NullFormatter

from envtf_lit.evaluation.toy import Beliefs
from envtf_lit.figures.style import COLOURS, LINES, drawing, observation_labels, write_table

PAIR = (COLOURS["imagined"], "#0072B2")  # of two things that are compared
MANY = ("#333333", "#0072B2", "#D55E00", "#009E73")
NEW = "magma_r"  # of novelty: the darker, the newer
LEAST, MOST = 1e-2, 1e3  # novelty that is drawn


def beliefs_on_a_line(
    found: Mapping[str, Beliefs], points: tuple[np.ndarray, np.ndarray], truth: np.ndarray, path: str | Path
) -> Path:
    """What models believe at each state: mean, noise (dark band) and all they do not know (light band), ±2 std each.

    Args:
        found: by model, all at the same states (N,).
        points: (M,) states and what followed them, as recorded.
        truth: (N,) the true mean.
        path: PNG to write; the numbers go beside it as CSV.
    """
    with drawing(path, (4.6 * len(found) + 0.3, 3.9), 1, len(found)) as (figure, axes):
        for axis, (name, one) in zip(axes.flat, found.items(), strict=True):
            axis.plot(*points, ".", color=COLOURS["data"], markersize=3, label="recorded", zorder=1)
            for band, opacity, label in ((one.std, 0.22, "± 2 std, all"), (one.aleatoric, 0.4, "± 2 std, noise")):
                low, high = one.mean - 2 * band, one.mean + 2 * band
                axis.fill_between(one.x, low, high, color=PAIR[0], alpha=opacity, lw=0, label=label, zorder=2)
            axis.plot(one.x, truth, color="black", linestyle="--", linewidth=1.3, label="truth", zorder=3)
            axis.plot(one.x, one.mean, color=PAIR[0], linewidth=2, label="model's mean", zorder=4)
            axis.set(title=name, xlabel="state x", ylim=(-2.6, 2.6))
            axis.label_outer()
        axes[0, 0].set_ylabel("next state x′")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize="small", frameon=False)
    tables = (pd.DataFrame(vars(one)).assign(model=name, truth=truth) for name, one in found.items())
    write_table(path, pd.concat(tables))
    return Path(path)


def reliability_plot(found: Mapping[str, pd.DataFrame], path: str | Path) -> Path:
    """Errors that came against spreads that were predicted; on the line, both are equal.

    Args:
        found: by model, up to two, the columns of `evaluation.reliability.reliability`.
        path: PNG to write; the numbers go beside it as CSV.
    """
    with drawing(path, (5.4, 4.3)) as (_, axes):
        axis = axes[0, 0]
        for (name, table), colour, (line, marker) in zip(found.items(), PAIR, LINES, strict=False):
            shown = table[(table > 0).all(axis=1)]
            axis.plot(shown["predicted"], shown["observed"], color=colour, linestyle=line, marker=marker, label=name)
        everything = pd.concat(found.values()).to_numpy()
        low, high = everything[everything > 0].min() / 1.5, everything.max() * 1.5
        axis.plot([low, high], [low, high], color="black", linewidth=0.9, label="honest")
        axis.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high))
        for scale in (axis.xaxis, axis.yaxis):
            _plain_numbers(scale)
        axis.set(xlabel="predicted spread (std of the data)", ylabel="error that came (std of the data)")
        axis.set_title("Is the error as large as it was said to be?")
        axis.legend(loc="upper left", fontsize="small")
    write_table(path, pd.concat(table.assign(model=name) for name, table in found.items()))
    return Path(path)


def novelty_over_states(
    found: tuple[np.ndarray, np.ndarray, np.ndarray],
    recorded: np.ndarray,
    dimensions: tuple[int, int],
    robot: str | None,
    path: str | Path,
) -> Path:
    """A map of novelty, with the recorded states on it and a line where novelty is one, at which rollouts are cut.

    Args:
        found: x, y and novelty, as `evaluation.reliability.novelty_map` gives them.
        recorded: (N, S) observations of the log.
        dimensions: those of the map.
        robot: gives the dimensions their names and units.
        path: PNG to write.
    """
    labels = observation_labels(robot, recorded.shape[1])
    x, y, novelty = found
    shown = np.clip(novelty, LEAST, MOST)
    with drawing(path, (6.6, 4.5)) as (figure, axes):
        axis = axes[0, 0]
        image = axis.pcolormesh(x, y, shown, norm=LogNorm(LEAST, MOST), cmap=NEW, shading="nearest")
        points = recorded[:: max(1, len(recorded) // 2_000)][:, dimensions]
        axis.plot(*points.T, ".", color="#009E73", markersize=2, alpha=0.6, label="recorded states")
        if novelty.min() < 1.0 < novelty.max():
            axis.contour(x, y, shown, levels=[1.0], colors="black", linewidths=1.8)
            axis.plot([], [], color="black", linewidth=1.8, label="novelty 1")
        axis.set(xlabel=labels[dimensions[0]], ylabel=labels[dimensions[1]], title="What the model takes for new")
        axis.grid(visible=False)
        axis.legend(loc="upper right", fontsize="small", markerscale=4)
        figure.colorbar(image, ax=axis, label="novelty")
    return Path(path)


def novelty_curves(scores: Mapping[str, np.ndarray], path: str | Path) -> Path:
    """Share of state-action pairs up to each novelty, a line for each kind of pairs, and the limit of one.

    Args:
        scores: by kind, up to four, novelties (N,).
        path: PNG to write; quantiles go beside it as CSV.
    """
    with drawing(path, (6.6, 3.7)) as (_, axes):
        axis = axes[0, 0]
        for (name, values), colour, (line, _) in zip(scores.items(), MANY, LINES, strict=False):
            ordered = np.sort(np.clip(values, LEAST / 10, 10 * MOST))
            share = np.arange(1, len(ordered) + 1) / len(ordered)
            axis.plot(ordered, share, color=colour, linestyle=line, linewidth=2, label=name)
        axis.axvline(1.0, color="black", linewidth=1.0)
        axis.annotate("limit", (1.0, 0.03), xytext=(4, 0), textcoords="offset points", fontsize="small")
        axis.set(xscale="log", xlabel="novelty", ylabel="share of pairs", ylim=(0, 1.01))
        _plain_numbers(axis.xaxis)
        axis.set_title("How new is each kind of pairs to the model?")
        axis.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    quantiles = np.linspace(0.0, 1.0, 21)
    columns = {name: np.quantile(values, quantiles) for name, values in scores.items()}
    write_table(path, pd.DataFrame({"quantile": quantiles, **columns}))
    return Path(path)


def cut_rollouts(found: Mapping[str, pd.DataFrame], path: str | Path) -> Path:
    """True errors of imagined steps (median, quartiles), and how many rollouts are still under way.

    Args:
        found: by name, up to two, the columns of `evaluation.reliability.errors_by_step`.
        path: PNG to write; the numbers go beside it as CSV.
    """
    with drawing(path, (10.0, 4.1), 1, 2) as (figure, axes):
        for (name, table), colour, (line, _) in zip(found.items(), PAIR, LINES, strict=False):
            look = dict(color=colour, linestyle=line, linewidth=2, label=name)
            left, right = axes.flat
            left.fill_between(table["step"], table["lower"], table["upper"], color=colour, alpha=0.18, lw=0)
            left.plot(table["step"], table["median"], **look)
            right.plot(table["step"], 100 * table["running"], **look)
        axes[0, 0].set(yscale="log", xlabel="imagined step", ylabel="true error of the step\n(std of the data)")
        _plain_numbers(axes[0, 0].yaxis)
        axes[0, 1].set(xlabel="imagined step", ylabel="rollouts under way (%)", ylim=(0, 102))
        figure.legend(*axes[0, 1].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    write_table(path, pd.concat(table.assign(rollouts=name) for name, table in found.items()))
    return Path(path)


def promise_and_truth(table: pd.DataFrame, recorded: float, path: str | Path) -> Path:
    """What a model promises of policies that go faster and faster, what they get, and how many rollouts are halted.

    Args:
        table: columns `speed`, `promised`, `true` (reward a step) and `halted` (share of rollouts).
        recorded: speed that the log's governor was set to, in m/s.
        path: PNG to write; the numbers go beside it as CSV.
    """
    with drawing(path, (10.0, 3.8), 1, 2) as (_, axes):
        left, right = axes.flat
        left.plot(table["speed"], table["promised"], color=PAIR[0], marker="o", linestyle="--", label="promised")
        left.plot(table["speed"], table["true"], color="black", marker="s", label="true")
        left.set(ylabel="mean reward of a step")
        right.plot(table["speed"], 100 * table["halted"], color=PAIR[1], marker="^")
        right.set(ylabel="rollouts halted as too new (%)", ylim=(-2, 102))
        for axis in axes.flat:
            axis.axvline(recorded, color="gray", linestyle=":", label="the log's governor")
            axis.set_xlabel("speed that the governor is set to (m/s)")
        left.legend(loc="lower left", fontsize="small")
    write_table(path, table)
    return Path(path)


def _plain_numbers(scale: Axis) -> None:
    """0.1, 0.3, 1 along a logarithmic axis, rather than powers that run into each other."""
    scale.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    scale.set_major_formatter("{x:g}")
    scale.set_minor_formatter(NullFormatter())
