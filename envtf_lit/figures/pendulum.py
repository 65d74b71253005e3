"""Pictures of the pendulum: how it swings, what each of its states is worth, and what two worlds make of it."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.ticker import MultipleLocator

from envtf_lit.figures.style import COLOURS, drawing, model_looks, write_table

WORTH = "viridis"  # of values: dark to bright, in greyscale too
HANDS = 12  # positions of the rod in a swing's picture


def swings(found: Mapping[str, np.ndarray], path: str | Path, *, title: str, step: float) -> Path:
    """The pendulum as a rod at evenly spaced moments of each episode, and below it its angle over time.

    Args:
        found: name to angles (T + 1,) in rad, upright at 0.
        path: PNG to write; the angles go beside it as CSV.
        title: over all of them.
        step: seconds.
    """
    with drawing(path, (1.0 * HANDS + 1.2, 1.2 * len(found) + 3.0), len(found) + 1, 1) as (figure, axes):
        axes[0, 0].get_gridspec().set_height_ratios([1.0] * len(found) + [1.7])
        looks = model_looks(found)
        for axis, (name, angle) in zip(axes[:-1, 0], found.items(), strict=True):
            moments = np.linspace(0, len(angle) - 1, HANDS).round().astype(int)
            for place, moment in enumerate(moments):
                tip = place + 0.42 * np.sin(angle[moment]), 0.42 * np.cos(angle[moment])
                axis.plot([place, tip[0]], [0, tip[1]], color=looks[name].colour, linewidth=3, solid_capstyle="round")
                axis.plot(place, 0, "o", color="black", markersize=3)
            axis.set(xlim=(-0.6, HANDS - 0.4), ylim=(-0.55, 0.55), aspect="equal", yticks=[])
            axis.set_xticks(range(HANDS), [f"{step * moment:.1f} s" for moment in moments], fontsize="small")
            axis.set_ylabel(name, rotation=0, ha="right", va="center")
            axis.grid(visible=False)
        below = axes[-1, 0]
        for place, (name, angle) in enumerate(found.items()):
            time, width = step * np.arange(len(angle)), 5.0 if place == 0 else 1.8  # the first behind the others
            below.plot(time, _broken(angle), color=looks[name].colour, linewidth=width, label=name)
        below.axhline(0.0, color=COLOURS["threshold"], linewidth=1.0)
        below.set(xlabel="time (s)", ylabel="angle (rad)\n0 is upright", ylim=(-np.pi, np.pi))
        below.margins(x=0)
        below.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
        figure.suptitle(title)
    tables = (pd.DataFrame({"episode": n, "time": step * np.arange(len(a)), "angle": a}) for n, a in found.items())
    write_table(path, pd.concat(tables))
    return Path(path)


def paths_in_worlds(found: Mapping[str, np.ndarray], path: str | Path, *, step: float, title: str) -> Path:
    """Angles under the same torques in several worlds, a panel for each plan.

    Args:
        found: world to angles (N, H + 1) in rad along N plans; the first is drawn broad and grey, as the truth.
        path: PNG to write; the angles go beside it as CSV.
        step: seconds.
        title: over all of them.
    """
    number, looks = len(next(iter(found.values()))), model_looks(found)
    with drawing(path, (3.1 * number + 1.2, 3.0), 1, number) as (figure, axes):
        for plan, axis in enumerate(axes[0]):
            for place, (name, angle) in enumerate(found.items()):
                colour, width = (COLOURS["data"], 5.0) if place == 0 else (looks[name].colour, 1.6)
                axis.plot(step * np.arange(angle.shape[1]), np.unwrap(angle[plan]), color=colour, lw=width, label=name)
            axis.set(xlabel="time (s)", title=f"plan {plan + 1}")
            axis.margins(x=0)
        axes[0, 0].set_ylabel("angle (rad)")
        axes[0, -1].legend(loc="center left", bbox_to_anchor=(1.02, 0.5), frameon=False)
        figure.suptitle(title)
    tables = (
        pd.DataFrame({"world": name, "plan": plan, "step": range(len(line)), "angle": line})
        for name, angle in found.items()
        for plan, line in enumerate(angle)
    )
    write_table(path, pd.concat(tables))
    return Path(path)


def value_maps(
    found: Mapping[str, np.ndarray], low: Sequence[float], high: Sequence[float], path: str | Path, *, title: str
) -> Path:
    """What each state of a plane is worth, a map for each world, all with the same colours.

    Args:
        found: world to values (X, Y) on an even grid.
        low, high: of angle (rad) and rate (rad/s).
        path: PNG to write; the values go beside it as CSV.
        title: over all of them.
    """
    ends = min(values.min() for values in found.values()), max(values.max() for values in found.values())
    with drawing(path, (4.2 * len(found) + 0.8, 3.7), 1, len(found)) as (figure, axes):
        for axis, (name, values) in zip(axes[0], found.items(), strict=True):
            extent = (low[0], high[0], low[1], high[1])
            axis.imshow(values.T, origin="lower", extent=extent, aspect="auto", vmin=ends[0], vmax=ends[1], cmap=WORTH)
            axis.contour(values.T, levels=8, extent=extent, colors="white", linewidths=0.6, alpha=0.7)
            axis.set(title=name, xlabel="angle (rad), upright at 0")
            axis.xaxis.set_major_locator(MultipleLocator(1.0))
            axis.grid(visible=False)
        axes[0, 0].set_ylabel("rate (rad/s)")
        figure.colorbar(axes[0, 0].images[0], ax=axes, label="value (discounted return)", pad=0.01)
        figure.suptitle(title)
    write_table(path, pd.concat(pd.DataFrame({"world": name, "value": v.ravel()}) for name, v in found.items()))
    return Path(path)


def _broken(angle: np.ndarray) -> np.ndarray:
    """Angles (T,) with a gap wherever the pendulum passes the bottom, so that no line crosses the picture."""
    jumps = np.abs(np.diff(angle, append=angle[-1])) > np.pi
    return np.where(jumps, np.nan, angle)
