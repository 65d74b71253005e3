"""The comparison's figures show what they are given, and write it beside them."""

from pathlib import Path

import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from envtf_lit.figures import comparison

AVERAGES = pd.DataFrame({"algorithm": ["A", "B"], "printed": [70.0, 60.0], "own": [20, 9], "equal": [60.0, 65.0]})
GAINS = pd.DataFrame(
    {"task": ["t", "u", "t"], "source": ["there", "there", "here"], "gain": [1.0, -2.0, 3.0],
     "low": [None, None, 1.0], "high": [None, None, 5.0]}
).astype({"low": float, "high": float})  # fmt: skip
COUNTS = pd.DataFrame({"A": [3, 0], "B": [1, 0]}, index=["t", "u"])


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Figures, in the place of files."""
    figures = list[Figure]()
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **how: (figures.append(figure), Path(path).touch()))
    return figures


def labels(axis: Axes) -> list[str]:
    return [label.get_text() for label in axis.get_yticklabels()]


def points(axis: Axes, label: str) -> list[tuple[float, float]]:
    (found,) = (marks for marks in axis.collections if marks.get_label() == label)
    return [(float(x), float(y)) for x, y in found.get_offsets()]  # pyright: ignore[reportGeneralTypeIssues]


def test_averages_are_ordered_by_the_equal_tasks(drawn: list[Figure], tmp_path: Path) -> None:
    comparison.averages_again(AVERAGES, 9, tmp_path / "f.png")
    axis = drawn[0].axes[0]
    assert labels(axis) == ["A (20 tasks)", "B (9 tasks)"] and axis.get_xlabel() == "mean normalised score"
    assert points(axis, "as printed") == [(70.0, 0.0), (60.0, 1.0)]
    assert points(axis, "over the same 9 tasks") == [(60.0, 0.0), (65.0, 1.0)]
    assert list(pd.read_csv(tmp_path / "f.csv")["algorithm"]) == ["B", "A"]


def test_gains_stand_in_the_row_of_their_task_with_their_interval(drawn: list[Figure], tmp_path: Path) -> None:
    comparison.gains_by_task(GAINS, tmp_path / "f.png", title="t")
    comparison.gains_by_task(GAINS.drop(columns=["low", "high"]), tmp_path / "f.png", title="without")
    axis, other = (figure.axes[0] for figure in drawn)
    assert labels(axis) == ["u", "t"]
    assert [(x, round(y)) for x, y in points(axis, "there")] == [(1.0, 1), (-2.0, 0)]
    assert [(x, round(y)) for x, y in points(axis, "here")] == [(3.0, 1)]
    assert points(axis, "there")[0][1] > points(axis, "here")[0][1]  # side by side
    assert len(axis.collections) == 4 and len(other.collections) == 2


def test_the_map_of_runs_has_a_number_where_there_are_any(drawn: list[Figure], tmp_path: Path) -> None:
    comparison.runs_there(COUNTS, tmp_path / "f.png", planned=3)
    axis = drawn[0].axes[0]
    assert [text.get_text() for text in axis.texts] == ["3", "1", "·", "·"]
    assert axis.get_title() == "Seeds that are finished, of 3" and labels(axis) == ["t", "u"]
    assert list(pd.read_csv(tmp_path / "f.csv").columns) == ["task", "A", "B"]
