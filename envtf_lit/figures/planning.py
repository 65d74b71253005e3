"""A picture of a plan: all candidates, the elites among them, and the plan that was made of them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from envtf_lit.figures.style import COLOURS, drawing

Group = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class PlanPicture:
    """What to draw: each group has a coordinate (N, H + 1) along its plans, and an action (N, H).

    Attributes:
        candidates: all of the last round.
        elites: the best of them.
        taken: the plan itself, N = 1.
        step: seconds.
        labels: of coordinate and action, with units.
        title: of the planner.
    """

    candidates: Group
    elites: Group
    taken: Group
    step: float
    labels: tuple[str, str]
    title: str


def plan_picture(plan: PlanPicture, path: str | Path) -> Path:
    """Draws the coordinate (left) and the action (right) over time, as PNG."""
    groups = (
        (plan.candidates, COLOURS["data"], 0.6, 0.35, "candidates"),
        (plan.elites, COLOURS["ensemble"], 1.0, 0.9, "elites"),
        (plan.taken, COLOURS["imagined"], 2.6, 1.0, "taken"),
    )
    with drawing(path, (10.0, 3.8), 1, 2) as (figure, axes):
        for side, (axis, label) in enumerate(zip(axes[0], plan.labels, strict=True)):
            for group, colour, width, alpha, name in groups:
                curves = group[side]
                time = plan.step * np.arange(curves.shape[1])
                drawn = axis.step if side else axis.plot
                lines = drawn(time, curves.T, color=colour, lw=width, alpha=alpha)
                lines[0].set_label(f"{name} ({len(curves)})" if len(curves) > 1 else name)
            axis.set(xlabel="time (s)", ylabel=label)
            axis.margins(x=0)
        axes[0, 0].legend(fontsize="small")
        figure.suptitle(f"A plan of {plan.title}, as the world model imagines it")
    return Path(path)
