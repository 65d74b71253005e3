"""One look for every plot: colours by meaning, labels with units, and PNG files with the same bytes every time."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib
import pandas as pd
import seaborn as sns
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from envtf_lit.files import replacing
from envtf_lit.robots.tasks import ROBOTS

# Okabe and Ito's palette, which colour-blind readers can tell apart
COLOURS = {
    "data": "#8c8c8c",
    "recorded": "#333333",
    "imagined": "#D55E00",
    "teacher_forced": "#56B4E9",
    "threshold": "#999999",
    "transformer": "#D55E00",
    "context_1": "#56B4E9",
    "ensemble": "#0072B2",
    "physics": "#000000",
}
LABELS = {
    "data": "dataset",
    "world_model": "world model",
    "recorded": "recorded\n(held out)",
    "imagined": "model, on the\nrecorded actions",
    "transformer": "transformer",
    "context_1": "transformer, context 1",
    "ensemble": "ensemble",
}
# of policies, in the order of params.yaml; none is that of imagination, which stands beside them
POLICY_COLOURS = (
    *("#E69F00", "#0072B2", "#009E73", "#CC79A7", "#56B4E9", "#8C564B", "#F0E442"),
    *("#000075", "#F032E6", "#66A61E", "#E6007E", "#222222", "#800000", "#DCBEFF"),  # far from those, and each other
)
# of models that have no colour of their own: each colour with the first line style and marker, then with the next
SPARE = ("#CC79A7", "#E69F00", "#F0E442", "#009E73")
LINES = (("-", "o"), ("--", "s"), ("-.", "^"), ((0, (1, 1)), "D"))
JOINTS = {
    "hopper": ("thigh", "leg", "foot"),
    "walker2d": ("right thigh", "right leg", "right foot", "left thigh", "left leg", "left foot"),
    "halfcheetah": ("back thigh", "back shin", "back foot", "front thigh", "front shin", "front foot"),
    "ant": tuple(f"{part} {leg}" for leg in (1, 2, 3, 4) for part in ("hip", "ankle")),
}


def observation_labels(robot: str | None, observation_dim: int) -> list[str]:
    """Name and unit of each observation dimension; `s[i]` for robots that are not ours."""
    if robot not in JOINTS or ROBOTS[robot].observation_dim != observation_dim:
        return [f"s[{i}]" for i in range(observation_dim)]
    joints = JOINTS[robot]
    angles, rates = [f"{joint} angle (rad)" for joint in joints], [f"{joint} rate (rad/s)" for joint in joints]
    if robot == "ant":
        pose = ["torso height (m)", *(f"torso quaternion {axis}" for axis in "wxyz")]
        motion = [f"{axis} velocity (m/s)" for axis in "xyz"] + [f"{axis} rotation (rad/s)" for axis in "xyz"]
    else:
        pose = ["torso height (m)", "torso pitch (rad)"]
        motion = ["x velocity (m/s)", "z velocity (m/s)", "pitch rate (rad/s)"]
    return [*pose, *angles, *motion, *rates]


def policy_colours(names: Iterable[str]) -> dict[str, str]:
    """A colour for each policy, in their order."""
    return dict(zip(names, cycle(POLICY_COLOURS), strict=False))


def featured(observation_dim: int) -> list[int]:
    """Up to four dimensions worth showing: the first two, the middle one (our robots' x velocity) and the last."""
    return sorted({0, min(1, observation_dim - 1), observation_dim // 2, observation_dim - 1})


@dataclass(frozen=True)
class Look:
    """How a model is drawn in every panel of a figure.

    Attributes:
        colour: of its line, band and marker.
        line: style of its line, as matplotlib has it.
        marker: of its points.
        label: in the legend.
    """

    colour: str
    line: Any
    marker: str
    label: str


def model_looks(models: Iterable[str]) -> dict[str, Look]:
    """A look for each model; those that are not ours are told apart up to the sixteenth."""
    spare = cycle((colour, line, marker) for line, marker in LINES for colour in SPARE)
    looks = {}
    for name in models:
        colour, line, marker = (COLOURS[name], *LINES[0]) if name in COLOURS else next(spare)
        looks[name] = Look(colour, line, marker, LABELS.get(name, name))
    return looks


@contextmanager
def drawing(
    path: str | Path, size: tuple[float, float], rows: int = 1, columns: int = 1
) -> Iterator[tuple[Figure, Any]]:
    """Yields a figure of `size` inches and its (rows, columns) array of axes, and writes it to `path` as PNG.

    Neither pyplot nor the user's back-end and settings are touched.
    """
    with matplotlib.rc_context(), sns.axes_style("whitegrid"), sns.plotting_context("notebook", font_scale=0.9):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure, figure.subplots(rows, columns, squeeze=False)
        with replacing(path) as temporary:
            figure.savefig(temporary, format="png", dpi=110, metadata={"Software": None})


def write_table(path: str | Path, table: pd.DataFrame) -> None:
    """Writes the numbers behind a plot beside it, as CSV."""
    with replacing(Path(path).with_suffix(".csv")) as temporary:
        table.to_csv(temporary, index=False, float_format="%.6g", lineterminator="\n")
