"""The tutorials' figures: written whole, the same bytes every time, with what they are drawn from beside them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from analytic import linear_data
from matplotlib.figure import Figure
from walker import walker_dataset

from envtf_lit.evaluation.coverage import visits
from envtf_lit.evaluation.toy import Beliefs, toy_truth
from envtf_lit.figures import attention, data, film, inline, objectives, uncertainty
from envtf_lit.robots.tasks import ROBOTS
from envtf_lit.world_models.forecast import whole_episodes

HOPPER = ROBOTS["hopper"]
LINE = np.linspace(-2, 2, 9)
BELIEFS = Beliefs(LINE, np.sin(LINE), np.full(9, 0.1), np.linspace(0, 1, 9))
SPREADS = pd.DataFrame({"predicted": [0.1, 0.5], "observed": [0.2, 0.4]})
QUARTILES = {"lower": [0.1, 0.1], "median": [0.2, 0.3], "upper": [0.4, 0.5]}
STEPS = pd.DataFrame({"step": [1, 2], **QUARTILES, "running": [1, 0.5]})
NOVELTIES = {"in": np.array([0.1, 0.5]), "out": np.array([2.0, 9.0])}
WALK = np.asarray(walker_dataset(1).observations)
MATRIX = np.array([[0.5, -np.inf], [1, 2]])
PROMISES = pd.DataFrame({"speed": [2.0, 3.0], "promised": [1.0, 2.0], "true": [1.0, -50.0], "halted": [0.0, 0.9]})
LOGS = {"whole": linear_data((30, 40)), "part": linear_data((20,))}
SCORES = {"random": np.arange(5.0), "medium": np.arange(20.0)}
GRID = (np.arange(4.0), np.arange(3.0), np.geomspace(0.1, 10, 12).reshape(3, 4))

DRAWN: dict[str, Callable[[Path], object]] = {
    "coverage": lambda path: data.coverage_maps(visits(LOGS, (0, 1), bins=4), None, 3, path),
    "quality": lambda path: data.quality_and_coverage(SCORES, {"random": 0.2, "medium": 0.6}, path),
    "guesses": lambda path: data.guesses({"a": (LINE, LINE), "b": (LINE, 0 * LINE)}, "return", path),
    "steps back": lambda path: attention.steps_back(np.full((2, 3, 4), 0.25), path),
    "objectives": lambda path: objectives.objective_curves(["nll", "paper_mse"], (0.1, 1.0), path),
    "beliefs": lambda path: uncertainty.beliefs_on_a_line({"m": BELIEFS}, (LINE, LINE), toy_truth(LINE)[0], path),
    "reliability": lambda path: uncertainty.reliability_plot({"m": SPREADS}, path),
    "novelties": lambda path: uncertainty.novelty_curves(
        {"in": np.array([0.1, 0.5]), "out": np.array([2.0, 9.0])}, path
    ),
    "cut": lambda path: uncertainty.cut_rollouts({"all": STEPS, "cut": STEPS}, path),
    "promises": lambda path: uncertainty.promise_and_truth(PROMISES, 2.5, path),
}
PICTURES: dict[str, Callable[[Path], object]] = {
    "maps": lambda path: attention.attention_maps(np.full((2, 2, 6, 6), 0.2), path),
    "matrices": lambda path: attention.small_matrices([("m", MATRIX)], path, ticks=["a", "b"]),
    "novelty": lambda path: uncertainty.novelty_over_states(GRID, np.zeros((5, 11)), (0, 5), "hopper", path),
    "film": lambda path: film.film_strip({"real": WALK}, HOPPER, [0, 9], path, title="t"),
}


@pytest.mark.parametrize("name", [*DRAWN, *PICTURES])
def test_a_figure_is_drawn_with_the_same_bytes_twice(name: str, tmp_path: Path) -> None:
    for time in ("first", "second"):
        (tmp_path / time).mkdir()
        (DRAWN | PICTURES)[name](tmp_path / time / "f.png")
    first, second = (sorted((tmp_path / time).iterdir()) for time in ("first", "second"))
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]
    assert [path.name for path in first] == (["f.csv", "f.png"] if name in DRAWN else ["f.png"])


@contextmanager
def caught(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Figure]]:
    """The figures that are written while it lasts."""
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **how: (figures.append(figure), Path(path).touch()))
    yield figures


def test_axes_have_names_and_units(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with caught(monkeypatch) as figures:
        for draw in DRAWN.values():
            draw(tmp_path / "f.png")
    for figure in figures:
        assert any(axis.get_xlabel() for axis in figure.axes) and any(axis.get_ylabel() for axis in figure.axes)
        assert all(axis.has_data() for axis in figure.axes)


def test_objectives_are_least_where_their_dots_are() -> None:
    for error in (0.1, 0.3, 1.0):
        assert objectives.best_spread("nll", error) == pytest.approx(error, rel=0.06)
        assert objectives.best_spread("paper_mse", error) == objectives.SPREADS[0]
    loss = objectives.expected_loss("paper_mse", 0.5, np.array([0.1, 1.0]))
    np.testing.assert_allclose(loss, [0.25 + 0.01, 0.25 + 1.0], rtol=0.03)


def test_a_film_has_no_picture_of_what_is_over_or_not_finite(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lost = WALK.copy()
    lost[5:] = np.nan
    strips = {"long": WALK, "short": WALK[:6], "lost": lost}
    with caught(monkeypatch) as figures:
        film.film_strip(strips, HOPPER, [0, 4, 9], tmp_path / "f.png", title="three")
    shown = [len(axis.images) for axis in figures[0].axes]
    assert shown == [1, 1, 1, 1, 1, 0, 1, 1, 0]
    assert len({tuple(map(round, axis.get_window_extent().size)) for axis in figures[0].axes}) == 1
    assert film.spread_steps(9, 3) == [0, 4, 9] and film.spread_steps(1) == [0, 1]


def test_a_recorded_trajectory_becomes_an_episode() -> None:
    log = walker_dataset(2)
    episode = film.recorded_episode(whole_episodes(log, 2, seed=0), 1, HOPPER)
    np.testing.assert_array_equal(episode.observations[:-1], log.observations[20:])
    np.testing.assert_array_equal(episode.observations[-1], log.next_observations[-1])
    np.testing.assert_array_equal(episode.positions[:, 1:], episode.observations[:, :5])
    walked = 0.008 * episode.observations[1:, 5].cumsum()  # seconds of a step, and x velocities
    np.testing.assert_allclose(episode.positions[1:, 0], walked, atol=1e-6)


# what notebooks show


def displayed(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What is displayed from now on."""
    shown: list[Any] = []
    monkeypatch.setattr(inline, "display", shown.append)
    return shown


def test_sentences_sources_and_figures_are_displayed(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = displayed(monkeypatch)
    inline.say("One.", "", "Two.")
    inline.show_source(film.spread_steps)
    inline.draw(uncertainty.reliability_plot, {"m": SPREADS}, alt="a line")
    assert shown[0].data == "One. Two."
    assert shown[1].data.startswith("```python\ndef spread_steps") and '"""' not in shown[1].data
    assert shown[2].data.startswith('<img alt="a line" src="data:image/png;base64,')


def test_printed_is_plain_text(capsys: pytest.CaptureFixture[str]) -> None:
    inline.show_printed("[bold]as it is[/bold]", "second")
    assert capsys.readouterr().out.split() == ["[bold]as", "it", "is[/bold]", "second"]


def test_a_folder_is_made_and_entered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    inline.enter_folder("new/one")
    assert Path.cwd() == tmp_path / "new/one"
    inline.enter_folder("")
    assert Path.cwd().name.startswith("envtf-tutorial-") and not any(Path.cwd().iterdir())
    Path.cwd().rmdir()
    monkeypatch.chdir(tmp_path)
