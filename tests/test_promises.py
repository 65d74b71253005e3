"""Promises: the range that they are, the frontier that they stand on, and what the report says of both."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from made_up_runs import made_up_run, some_estimates, some_frontier
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from envtf_lit.agents.trust_levels import LEVELS
from envtf_lit.errors import UserError
from envtf_lit.evaluation.metrics import held_out_metrics
from envtf_lit.evaluation.promises import Places, Range, kept, promised_range, read_frontier
from envtf_lit.figures import frontier as frontier_module
from envtf_lit.figures import promises
from envtf_lit.figures.frontier import frontier_picture
from envtf_lit.figures.report import Run, read_run
from envtf_lit.figures.style import drawing
from envtf_lit.files import write_table

HELD_OUT = held_out_metrics(some_estimates())  # the model imagines 10 more than was recorded, in 45 steps


HEADER = "update,excess,promise,error,low,high,lost,steps,kept"

# the range


def test_a_range_holds_what_episodes_returned_and_the_models_error_on_recorded_actions_for_each_step() -> None:
    assert HELD_OUT["imagined_return_mean"] - HELD_OUT["return_mean"] == pytest.approx(10.0)
    assert HELD_OUT["steps_mean"] == 45.0
    row = {"promise": 100.0, "error": 1.0, "low": 60.0, "high": 110.0, "steps": 90.0}
    found = promised_range(row, HELD_OUT)
    assert (found.low, found.high) == pytest.approx((60.0 - 20.0, 110.0 + 20.0))
    lower = HELD_OUT | {"imagined_return_mean": HELD_OUT["return_mean"] - 10.0}
    assert promised_range(row, lower) == found  # it may be wrong to either side
    assert promised_range(row, HELD_OUT | {"imagined_return_mean": HELD_OUT["return_mean"]}) == Range(60.0, 110.0)
    assert 40.0 in found and 39.9 not in found and 130.1 not in found


# the frontier on disk


def test_a_frontier_is_read_as_it_was_written(tmp_path: Path) -> None:
    assert read_frontier(tmp_path) is None
    write_table(tmp_path / "frontier.csv", some_frontier(1))
    assert read_frontier(tmp_path) == some_frontier(1)
    assert kept(some_frontier(1))["update"] == 200


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "it has no error and no excess and no high and no kept"),
        ("update,excess,promise,error,low,high,lost,kept\n0,0,1,1,0,2,0,1\n", "it has no steps"),
        (f"{HEADER}\n0,0,1,1,0,2,0,9,0\n", "does not name one actor as kept"),
        (f"{HEADER}\n0,,1,1,0,2,0,9,1\n", "does not name one actor as kept"),
    ],
)
def test_a_damaged_frontier_is_refused(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "frontier.csv").write_text(text)
    with pytest.raises(UserError, match=f"{words}.*train the policy anew"):
        read_frontier(tmp_path)


# the picture


def test_the_picture_marks_clone_published_and_measured_and_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Figure] = []

    @contextmanager
    def watched(*args: Any) -> Iterator[Any]:
        with drawing(*args) as (figure, axes):
            seen.append(figure)
            yield figure, axes

    monkeypatch.setattr(frontier_module, "drawing", watched)
    frontier_picture(
        {"a": some_frontier()},
        tmp_path / "f.png",
        held_out=HELD_OUT,
        recorded=300.0,
        policies={"bc": "BC", "a": "A"},
        measured={"a": 250.0, "a/clone": 280.0, "bc": 1.0},
    )
    axis = seen[0].axes[0]
    points: dict[str, list[tuple[float, float]]] = {}
    for shown in axis.collections:
        if isinstance(shown, PathCollection):
            points.setdefault(str(shown.get_label()), []).append(tuple(np.array(shown.get_offsets())[0].tolist()))
    assert points == {
        "the clone": [(0.0, 310.0)],
        "published": [(0.2, 420.0)],
        "measured": [(0.0, 280.0), (0.2, 250.0)],
    }
    assert [np.array(line.get_ydata())[0] for line in axis.lines if line.get_label() == "the log's mean episode"] == [
        300
    ]
    assert [text.get_text().split(":")[0] for text in axis.texts] == ["cautious"]  # the others lie beyond
    table = pd.read_csv(tmp_path / "f.csv")
    expected = [promised_range(row, HELD_OUT) for row in some_frontier()]
    np.testing.assert_allclose(table["low"], [found.low for found in expected], rtol=1e-5)
    np.testing.assert_allclose(table["high"], [found.high for found in expected], rtol=1e-5)


# what the report says


@pytest.fixture(scope="module")
def offline(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return read_run(made_up_run(tmp_path_factory.mktemp("offline"), simulator=False), simulator=False)


def changed(run: Run, table: Places | None = None, *, recorded: float = 320.0, trust: str = "default") -> Run:
    """The run with another frontier, mean recorded return, or level of trust."""
    told = replace(run, card=run.card | {"returns": {"mean": recorded}})
    vars(told)["frontiers"] = {"dreamer": some_frontier() if table is None else table}
    vars(told)["trust"] = lambda name: trust
    return told


def test_it_says_what_is_promised_what_was_earned_and_who_is_published_and_why(offline: Run) -> None:
    text = promises.about_promises(changed(offline))
    assert "ET + CQL (`trust: default`) is promised **390 to 450**; the log's mean episode earned 320." in text
    assert "the actor after update 400: +34% over the clone's promise" in text and "cost 20% at this trust" in text
    assert "+0.22 for each step" in text and "simulator" not in text
    text = promises.about_promises(changed(offline, some_frontier(0)))
    assert "Published is the clone: nobody further out was promised enough more, 5% at least, and 100% for" in text
    assert "beyond the log" not in text
    assert "costs nothing" in promises.about_promises(changed(offline, trust="bold"))


def test_where_there_is_a_simulator_it_says_whether_the_promise_held(tmp_path: Path) -> None:
    run = read_run(made_up_run(tmp_path), simulator=True)
    text = promises.about_promises(run)
    assert "it earned 201, **outside the range**. The clone earned 280 there." in text
    run.policies["dreamer"]["return_mean"] = 400.0
    assert "it earned 400, inside the range." in promises.about_promises(run)


def test_policies_beyond_the_log_are_called_so_for_distance_and_for_straying(offline: Run) -> None:
    text = promises.first_to_try(changed(offline))
    assert "ET + CQL **acts beyond the log**: held-out actions are 0.20 nats per dimension less likely" in text
    assert "; in 3.0% of its imagined steps" in text
    near = promises.first_to_try(changed(offline, some_frontier(1)))
    assert "beyond the log" not in near and "way from the log" not in near
    strays = some_frontier(1)
    strays[1]["lost"] = 0.02
    text = promises.first_to_try(changed(offline, strays))
    assert "ET + CQL **acts beyond the log**: in 2.0% of its imagined steps" in text and "less likely" not in text
    for excess, words in ((0.2, "is some way from the log"), (0.31, "**acts beyond the log**")):
        far = some_frontier(1)
        far[1]["excess"] = excess
        assert f"ET + CQL {words}: held-out actions are {excess:.2f}" in promises.first_to_try(changed(offline, far))


def test_it_says_what_to_try_first_and_what_before(offline: Run) -> None:
    text = promises.first_to_try(changed(offline))
    assert "**Try first ET + CQL** (`trust: default`)" in text
    assert "try `trust: cautious`" in text and "was promised 334 to 366" in text
    assert "cautious" not in promises.first_to_try(changed(offline, some_frontier(1)))
    risky = some_frontier()
    risky[2]["low"] = -50.0  # of single episodes; the log's mean is compared with the mean
    text = promises.first_to_try(changed(offline, risky))
    assert "**Try first ET + CQL**" in text and "promised mean, 390 to 450, lies above the 320" in text
    assert "any single episode of its range, -70 to 450" in text
    text = promises.first_to_try(changed(offline, recorded=400.0))  # within the range
    assert "**Try first what is nearest to the log**: the clone in `models/policy/dreamer/clone`" in text
    assert "Try first ET" not in text
    assert LEVELS["cautious"].slack == promises.NEAR


def test_of_several_levels_the_nearest_to_the_log_that_surely_gains_is_first(offline: Run) -> None:
    run = changed(offline)
    near = run.policies["dreamer"] | {"label": "Near"}
    run = replace(run, metrics=run.metrics | {"policies": run.policies | {"near": near}})
    vars(run)["frontiers"] = {"dreamer": some_frontier(2), "near": some_frontier(1)}
    vars(run)["trust"] = {"dreamer": "default", "near": "cautious"}.get
    run.card["returns"] = {"mean": 320.0}
    assert "**Try first Near** (`trust: cautious`)" in promises.first_to_try(run)
    assert "ET + CQL **acts beyond the log**" in promises.first_to_try(run)
    run.card["returns"] = {"mean": 360.0}
    text = promises.first_to_try(run)
    assert "**Try first ET + CQL**" in text and "Before it" not in text  # the cautious one is there


def test_a_run_without_a_frontier_promises_nothing(offline: Run) -> None:
    run = changed(offline)
    vars(run)["frontiers"] = {}
    assert promises.first_to_try(run) == "" and len(promises.frontier_table(run)) == 0
    assert "None of these policies" in promises.about_promises(run)
