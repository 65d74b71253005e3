"""Plots of the world model: errors over the horizon, predictions against outcomes, calibration, uncertainty."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from envtf_lit.evaluation.calibration import coverage
from envtf_lit.evaluation.horizon import HorizonReport, error_quartiles
from envtf_lit.figures.style import COLOURS, drawing, featured, observation_labels, write_table
from envtf_lit.world_models.forecast import Scale, steps_within


def horizon_errors(report: HorizonReport, path: str | Path) -> Path:
    """Median and quartiles of the nmse by step: open loop and teacher-forced, in panels of their own."""
    runs = {
        "open loop": (report.open_loop_nmse, "imagined"),
        "teacher-forced": (report.teacher_forced_nmse, "teacher_forced"),
    }
    tables = []
    with drawing(path, (10.5, 4.0), 1, 2) as (figure, axes):
        for axis, (name, (error, colour)) in zip(axes.flat, runs.items(), strict=True):
            table = pd.DataFrame(error_quartiles(error, report.trajectories.lengths))
            axis.fill_between(
                table["step"],
                table["lower"],
                table["upper"],
                color=COLOURS[colour],
                alpha=0.25,
                lw=0,
                label="quartiles",
            )
            axis.plot(table["step"], table["median"], color=COLOURS[colour], label="median")
            for threshold, style in ((0.01, ":"), (0.1, "--")):
                axis.axhline(threshold, color="black", linestyle=style, linewidth=1.2, label=f"threshold {threshold:g}")
            axis.set(xscale="log", yscale="log", xlabel="step h", title=f"{name}")
            tables.append(table.assign(run=name))
        axes[0, 0].set_ylabel("normalised squared error")
        axes[0, 1].sharey(axes[0, 0])
        axes[0, 1].legend(fontsize="small", loc="upper right")
        figure.suptitle(f"Error on {len(report.trajectories.lengths)} held-out episodes (those that last h steps)")
    write_table(path, pd.concat(tables))
    return Path(path)


def one_step_predictions(report: HorizonReport, robot: str | None, path: str | Path, *, points: int = 2000) -> Path:
    """Predicted against recorded one-step changes of featured dimensions, and the reward, at evenly spaced steps."""
    valid, observations = report.trajectories.valid, report.trajectories.observations
    chosen = np.unique(np.linspace(0, int(valid.sum()) - 1, points).astype(int))
    recorded, predicted = (
        x[valid][chosen].cpu().numpy() for x in (report.trajectories.targets, report.teacher_forced_forecast.mean)
    )
    before = observations[valid][chosen].cpu().numpy()
    size = before.shape[-1]
    labels = [f"change of {name}" for name in observation_labels(robot, size)]
    panels = [(labels[i], recorded[:, i] - before[:, i], predicted[:, i] - before[:, i]) for i in featured(size)[1:]]
    panels.append(("reward", recorded[:, -1], predicted[:, -1]))
    with drawing(path, (3.5 * len(panels), 3.9), 1, len(panels)) as (figure, axes):
        for axis, (name, x, y) in zip(axes.flat, panels, strict=True):
            low, high = float(x.min()) - 1e-6, float(x.max()) + 1e-6  # a constant has a width, too
            axis.plot([low, high], [low, high], color="black", linewidth=1, zorder=1)
            axis.scatter(x, y, s=6, color=COLOURS["imagined"], alpha=0.3, linewidths=0, zorder=2)
            unexplained = float(((y - x) ** 2).sum() / max(float(((x - x.mean()) ** 2).sum()), 1e-12))
            axis.set(xlabel="recorded", xlim=(low, high), ylim=(low, high))
            axis.xaxis.set_major_locator(MaxNLocator(4))
            axis.set_title(f"{name}\nunexplained variance {unexplained:.2g}", fontsize="medium")
        axes[0, 0].set_ylabel("predicted")
        figure.suptitle("One step ahead, on held-out episodes")
    tables = [pd.DataFrame({"quantity": name, "recorded": x, "predicted": y}) for name, x, y in panels]
    write_table(path, pd.concat(tables))
    return Path(path)


def calibration_curve(report: HorizonReport, scale: Scale, robot: str | None, path: str | Path) -> Path:
    """Observed against nominal coverage of central intervals (left), and each dimension's at 50 and 90 per cent."""
    levels = np.linspace(0.05, 0.95, 19)
    observed = [coverage(report.teacher_forced_forecast, report.trajectories, scale, level).mean for level in levels]
    halves, most = (coverage(report.teacher_forced_forecast, report.trajectories, scale, level) for level in (0.5, 0.9))
    labels = [*observation_labels(robot, len(scale.std) - 1), "reward"]
    names = [
        name.partition(" (")[0] for name, share in zip(labels, halves.by_dimension, strict=True) if share is not None
    ]
    with drawing(path, (10.0, max(4.2, 0.26 * len(names) + 1.2)), 1, 2) as (figure, axes):
        left, right = axes.flat
        left.plot([0, 1], [0, 1], color="black", linewidth=1, label="calibrated")
        left.plot(levels, observed, color=COLOURS["imagined"], marker="o", markersize=4, label="world model")
        left.set(xlabel="nominal coverage", ylabel="observed coverage", xlim=(0, 1), ylim=(0, 1), aspect="equal")
        left.legend(loc="upper left")
        for shares, level, marker in ((halves, 0.5, "o"), (most, 0.9, "s")):
            alive = [share for share in shares.by_dimension if share is not None]
            right.scatter(
                alive, range(len(names)), color=COLOURS["imagined"], marker=marker, label=f"{level:.0%}", zorder=2
            )
            right.axvline(level, color="black", linewidth=1, zorder=1)
        right.set(xlim=(0, 1.02), xlabel="observed coverage", ylim=(len(names) - 0.5, -0.5))
        right.set_yticks(range(len(names)), names)
        right.legend(title="nominal", loc="lower left", fontsize="small")
        figure.suptitle("Do outcomes fall inside the predicted intervals as often as they should?")
    write_table(path, pd.DataFrame({"nominal": levels, "observed": observed}))
    return Path(path)


def traces(report: HorizonReport, robot: str | None, path: str | Path, *, steps: int = 200) -> Path:
    """Recorded and imagined (open-loop) values of featured dimensions along the held-out episode of median quality.

    The reward takes a free panel. The band is twice the predicted standard deviation of a single step, given the
    imagined state before it. The median is that of the number of steps within nmse 0.1.
    """
    lengths = report.trajectories.lengths
    within, _ = steps_within(report.open_loop_nmse, lengths, 0.1)
    row = report.median_row
    end = min(int(lengths[row]), steps)
    recorded, mean, std = (
        x[row, :end].cpu().numpy()
        for x in (report.trajectories.targets, report.open_loop_forecast.mean, report.open_loop_forecast.std)
    )  # fmt: skip
    labels, h = [*observation_labels(robot, recorded.shape[-1] - 1), "reward"], np.arange(1, end + 1)
    shown = [*featured(len(labels) - 1), len(labels) - 1][:4]
    tables = []
    with drawing(path, (10.0, 5.6), 2, 2) as (figure, axes):
        for axis in axes.flat[len(shown) :]:
            axis.remove()
        for axis, i in zip(axes.flat, shown, strict=False):
            band = {"lower": mean[:, i] - 2 * std[:, i], "upper": mean[:, i] + 2 * std[:, i]}
            axis.fill_between(
                h, band["lower"], band["upper"], color=COLOURS["imagined"], alpha=0.25, lw=0, label="±2 std"
            )
            axis.plot(h, recorded[:, i], color=COLOURS["recorded"], label="recorded")
            axis.plot(h, mean[:, i], color=COLOURS["imagined"], linestyle="--", label="imagined")
            low, high = recorded[:, i].min(), recorded[:, i].max()
            margin = 0.75 * (high - low) + 1e-6  # an imagination that runs away may leave the picture
            axis.set(ylabel=labels[i], xlim=(1, max(end, 2)), ylim=(low - margin, high + margin))
            axis.axvline(int(within[row]) + 0.5, color="black", linestyle=":", linewidth=1.2, label="nmse passes 0.1")
            tables.append(
                pd.DataFrame(
                    {"quantity": labels[i], "step": h, "recorded": recorded[:, i], "imagined": mean[:, i], **band}
                )
            )
        for axis in axes.flat[: len(shown)][-2:]:
            axis.set_xlabel("step")
        axes[0, 1].legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
        figure.suptitle("A held-out episode of median quality, imagined from its first state and its actions alone")
    write_table(path, pd.concat(tables))
    return Path(path)


def rollout_uncertainty(step: np.ndarray, uncertainty: np.ndarray, path: str | Path) -> Path:
    """Quantiles of the imagined transitions' uncertainty u by the number of imagined steps before them, (M,) each."""
    rows = [(int(s), *np.quantile(uncertainty[step == s], (0.05, 0.25, 0.5, 0.75, 0.95)), int((step == s).sum()))
            for s in np.unique(step)]  # fmt: skip
    table = pd.DataFrame(rows, columns=["step", "q05", "q25", "median", "q75", "q95", "transitions"])
    with drawing(path, (7.4, 4.0)) as (figure, axes):
        axis = axes[0, 0]
        x, colour = table["step"] + 1, COLOURS["imagined"]
        axis.fill_between(x, table["q05"], table["q95"], color=colour, alpha=0.15, lw=0, label="5 to 95 %")
        axis.fill_between(x, table["q25"], table["q75"], color=colour, alpha=0.3, lw=0, label="25 to 75 %")
        axis.plot(x, table["median"], color=colour, marker="o", markersize=4, label="median")
        axis.set(yscale="log", xlabel="imagined step", ylabel="uncertainty u (in standard deviations)")
        axis.set_title("Uncertainty of imagined transitions")
        axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter(NullFormatter())
        if len(table) <= 20:
            axis.set_xticks(x)
        figure.legend(loc="outside right upper", fontsize="small")
    write_table(path, table)
    return Path(path)


def horizon_table(report: HorizonReport) -> pd.DataFrame:
    """Steps within each threshold, open loop and teacher-forced, as rows."""
    runs = (("open loop", report.open_loop), ("teacher-forced", report.teacher_forced))
    rows = [
        (name, threshold, steps.mean, steps.standard_error, steps.median, steps.censored)
        for name, by_threshold in runs
        for threshold, steps in by_threshold.items()
    ]
    return pd.DataFrame(rows, columns=["run", "threshold", "mean", "standard_error", "median", "censored"])
