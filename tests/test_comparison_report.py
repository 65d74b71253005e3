"""The comparison's report, on made-up results whose numbers are known."""

import json
import re
from pathlib import Path
from typing import Any, cast

import pandas as pd
import pytest
from PIL import Image

from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.cli.main import main
from envtf_lit.comparison import page
from envtf_lit.comparison.budgets import BUDGETS, budget_of
from envtf_lit.comparison.findings import early, first_alone, harm, logs, missing, standings, updates_to_reach
from envtf_lit.comparison.grid import KITS
from envtf_lit.comparison.records import Run, Shared, add_run, with_weighted_bc
from envtf_lit.comparison.references import PAPER, TASK_SETS, mean_over, published_columns
from envtf_lit.comparison.report import report
from envtf_lit.comparison.statistics import Estimate
from envtf_lit.comparison.view import View
from envtf_lit.errors import UserError
from envtf_lit.robots.tasks import ROBOTS, TASKS, TIERS
from tests.made_up_comparison import BUDGET, some_curve, some_run, write_comparison

# four tasks, three seeds: IQM of 12 runs leaves out the three least and the three greatest
FOUR = ("hopper-medium", "hopper-medium-replay", "walker2d-medium", "ant-random")
LEVELS = {"wbc": (30.0, 20.0, 40.0, 0.0), "cql": (50.0, 40.0, 60.0, -10.0), "et_cql": (80.0, 40.0, 90.0, 10.0)}
LOGS = {"hopper-medium": (25.0, 70.0), "hopper-medium-replay": (10.0, 75.0), "ant-random": (5.0, 9.0)}


def some_runs() -> list[Run]:
    return [
        some_run(task, name, level + step, seed=seed, seconds=100.0 + seed)
        for name, levels in LEVELS.items()
        for task, level in zip(FOUR, levels, strict=True)
        for seed, step in enumerate((-1.0, 0.0, 1.0))
    ]


@pytest.fixture
def results(tmp_path: Path) -> Path:
    write_comparison(tmp_path / "results.csv", some_runs(), LOGS)
    return tmp_path / "results.csv"


def view_of(runs: list[Run], kit: str = "same") -> View:
    return View.of(runs, kit, str(BUDGET))


def lines_of(text: str, begin: str) -> list[list[str]]:
    """Cells of the rows of Markdown tables that begin with a word."""
    return [
        [cell.strip().strip("*") for cell in line.strip("|").split("|")]
        for line in text.splitlines()
        if line.startswith(f"| {begin} |")
    ]


# what is found


def test_the_iqm_of_known_scores_is_known() -> None:
    view = view_of(some_runs())
    found = standings(view, [], [])
    ordered = sorted(run.score_final for run in view.runs if run.algorithm == "et_cql")
    middle: Any = pytest.approx(sum(ordered[3:9]) / 6)
    low, high = (cast(Any, pytest.approx(bound, abs=1.0)) for bound in (59.8, 60.2))
    assert found["et_cql"].iqm == Estimate(middle, low, high, 12)
    assert found["et_cql"].iqm.value == 60.0  # pyright: ignore[reportOptionalMemberAccess]
    assert found["et_cql"].iqm_last10 is not None and found["et_cql"].iqm_last10.value == pytest.approx(58.0)
    assert (found["et_cql"].mean, found["et_cql"].best) == (55.0, 59.0)
    over = found["et_cql"].difference["cql"]
    assert (over.over_seeds.value, over.over_seeds.low, over.over_seeds.high) == (20.0, 20.0, 20.0)
    assert (over.over_seeds.count, over.over_tasks.count) == (12, 4)
    assert over.over_tasks.low is not None and over.over_tasks.low < 0.0  # 30, 0, 30, 20: other tasks may differ
    assert found["et_cql"].improvement["cql"].value == pytest.approx((1 + 0.5 + 1 + 1) / 4)
    assert "cql" not in found["cql"].difference and "wbc" in found["cql"].difference


def test_first_alone_are_those_without_an_equal() -> None:
    assert first_alone(view_of(some_runs())) == ["et_cql", "et_cql", "et_cql"]  # both have 40 on the fourth
    assert first_alone(view_of([run for run in some_runs() if run.algorithm == "cql"])) == []


def test_harm_is_what_is_a_tenth_below_the_larger_yardstick() -> None:
    runs = [
        some_run("hopper-medium", "wbc", 30.0),
        some_run("hopper-medium", "cql", 27.1),
        some_run("hopper-medium", "iql", 26.9),
        some_run("hopper-medium-replay", "cql", 9.1),  # the log's mean is 10
        some_run("hopper-medium-replay", "iql", 8.9),
        some_run("ant-random", "wbc", -10.0),
        some_run("ant-random", "cql", -10.9),
        some_run("ant-random", "iql", -11.1),
        some_run("walker2d-medium", "cql", -50.0),  # nothing to hold it against
    ]
    known = logs(
        [
            Shared("hopper", "medium", str(BUDGET), "dataset", 1.0, 1.0, 9, 9, 25.0, 70.0),
            Shared("hopper", "medium-replay", str(BUDGET), "dataset", 1.0, 1.0, 9, 9, 10.0, 75.0),
            Shared("walker2d", "medium", "gpu", "dataset", 1.0, 1.0, 9, 9, 10.0, 75.0),
        ],
        str(BUDGET),
    )
    harmful, judged = harm(view_of(with_weighted_bc(runs)), known)
    assert [(found.run.robot, found.run.tier, found.yardstick) for found in harmful] == [
        ("hopper", "medium", 30.0),
        ("hopper", "medium-replay", 10.0),
        ("ant", "random", -10.0),
    ]
    assert {found.run.algorithm for found in harmful} == {"iql"} and judged == 6


def test_updates_to_ninety_percent_are_of_the_final_score() -> None:
    run = some_run(score=50.0)
    assert updates_to_reach(run, some_curve(run, [10.0, 44.9, 45.0, 60.0])) == 0.75
    assert updates_to_reach(run, some_curve(run, [10.0, 20.0])) is None
    assert updates_to_reach(some_run(score=-5.0), some_curve(run, [10.0])) is None


def test_what_is_missing_is_what_the_plan_has_and_more_was_begun() -> None:
    view = view_of([*some_runs(), some_run("hopper-medium", "bc", 1.0, seed=7)])
    cells = missing(view, BUDGET)
    plan = KITS["same"]
    assert len(cells) == 20 * (len(plan.algorithms) + 1) * (len(plan.seeds) + 1) - len(view.runs)
    assert {cell.algorithm for cell in cells} >= {"iql", "bc"} and {cell.seed for cell in cells} == {0, 1, 2, 7}
    assert not {cell.key for cell in cells} & {run.key for run in view.runs}


def test_an_algorithm_with_few_runs_is_shown_and_not_compared() -> None:
    view = view_of([*some_runs(), some_run("hopper-medium", "iql", 99.0)])
    assert view.algorithms == ["wbc", "iql", "cql", "et_cql"]
    assert view.compared == ["wbc", "cql", "et_cql"]
    assert view.common == {task: [0, 1, 2] for task in FOUR}
    found = standings(view, [], [])
    assert found["iql"].iqm is None and found["iql"].worst.score_final == 99.0
    assert found["cql"].iqm == standings(view_of(some_runs()), [], [])["cql"].iqm


def test_algorithms_are_compared_on_the_runs_that_all_have() -> None:
    runs = [run for run in some_runs() if (run.algorithm, run.robot, run.seed) != ("cql", "ant", 2)]
    view = view_of(runs)
    assert view.common["ant-random"] == [0, 1]
    assert {found.iqm.count for found in standings(view, [], []).values() if found.iqm is not None} == {11}


# the page


def test_the_report_says_what_is_known(results: Path, tmp_path: Path) -> None:
    out = tmp_path / "report"
    summary = report(results, out)
    text = (out / "index.md").read_text()
    assert summary == json.loads((out / "summary.json").read_text())
    assert summary["comparison.budget"] == "cpu-small" and summary["comparison.runs"] == 36
    assert (summary["same.et_cql.iqm"], summary["same.et_cql.first_alone"]) == (60.0, 3)
    assert summary["same.et_cql.over_cql"] == 20.0 and summary["same.et_cql.over_cql_interval"] == [20.0, 20.0]
    final, last = lines_of(text, "hopper-medium")[:2]
    assert final[1:] == ["30.0 ± 2.5 (3)", "50.0 ± 2.5 (3)", "80.0 ± 2.5 (3)", "25.0", "70.0"]
    assert last[1:4] == ["28.0 ± 2.5 (3)", "48.0 ± 2.5 (3)", "78.0 ± 2.5 (3)"]
    assert "**80.0 ± 2.5 (3)**" in text
    assert lines_of(text, "walker2d-medium")[0][-2:] == ["–", "–"]  # its log is not known
    ours = next(row for row in lines_of(text, "ET + CQL") if row[1] == "12")
    assert ours[6:] == ["3", "2 of 3", "59.0"]
    assert ours[5] == "9.0 (ant-random, seed 0)"
    harmful = [row for row in lines_of(text, "CQL") if row[1].startswith("ant-random")]
    assert [row[2:] for row in harmful] == [["-11.0", "5.0"], ["-10.0", "5.0"], ["-9.0", "5.0"]]
    assert "3 of 24 runs score below 90 %" in text
    costs = next(row for row in lines_of(text, "ET + CQL") if row[1] == "100 %")
    assert costs[2:] == ["101", "220", "700"]
    assert "384 of 420 planned runs are missing" in text and "seeds 0, 1, 2 of all tasks" in text
    assert "## As published" not in text


def test_figures_are_drawn_with_their_numbers_beside(results: Path, tmp_path: Path) -> None:
    report(results, tmp_path / "report")
    curves = pd.read_csv(tmp_path / "report/curves_same.csv")
    assert len(curves) == 36 * 4
    assert list(curves["algorithm"].unique()) == ["Weighted BC", "CQL", "ET + CQL"]
    assert list(curves["robot"].unique()) == ["hopper", "walker2d", "ant"]
    found = pd.read_csv(tmp_path / "report/scores_same.csv")
    assert list(found["algorithm"]) == ["ET + CQL", "CQL", "Weighted BC"] and found["value"][0] == 60.0  # pyright: ignore[reportGeneralTypeIssues]
    for name in ("curves", "scores"):
        with Image.open(tmp_path / f"report/{name}_same.png") as image:
            assert min(image.size) > 200
        assert f"]({name}_same.png)" in (tmp_path / "report/index.md").read_text()


def test_a_single_run_without_any_other_file_is_enough(tmp_path: Path) -> None:
    results = tmp_path / "results.csv"
    add_run(results, some_run("ant-random", "et_cql", 10.0, kit="published"), [])
    (tmp_path / "curves.csv").unlink()
    summary = report(results, tmp_path / "report")
    text = (tmp_path / "report/index.md").read_text()
    assert summary["published.et_cql.mean"] == 10.0
    assert lines_of(text, "ant-random")[0] == ["ant-random", "10.0 (1)", "–", "–"]
    assert "0 of 0 runs score below" in text and "## Same kit" not in text
    assert not (tmp_path / "report/curves_published.png").exists() and "curves_published" not in text


def test_less_data_stands_beside_the_whole(tmp_path: Path) -> None:
    results = tmp_path / "results.csv"
    tenth, half = (budget_of("cpu-small", data_share=share) for share in (0.1, 0.5))
    runs = [some_run(score=50.0, seed=seed) for seed in (0, 1)]
    runs += [
        some_run(score=20.0, budget=tenth),
        some_run(score=40.0, budget=half),
        some_run(score=44.0, seed=1, budget=half),
    ]
    runs += [some_run(score=1.0, budget=budget_of("cpu-small", data_share=0.1, updates=50))]  # another length
    write_comparison(results, runs)
    report(results, tmp_path / "report", budget="cpu-small")
    text = (tmp_path / "report/index.md").read_text()
    assert "| runs of each | 10 % | 50 % | 100 % |" in text
    assert next(row for row in lines_of(text, "CQL") if len(row) == 5 and row[1] == "1") == [
        "CQL",
        "1",
        "20.0",
        "40.0",
        "50.0",
    ]


def test_runs_that_diverged_and_several_versions_are_said(tmp_path: Path) -> None:
    results = tmp_path / "results.csv"
    runs = [some_run(updates=4_000), some_run(seed=1, commit="def")]
    write_comparison(results, runs)
    report(results, tmp_path / "report")
    text = (tmp_path / "report/index.md").read_text()
    assert early(view_of(runs)) == runs[:1]
    assert "- CQL, hopper-medium, seed 0: after 4,000 updates" in text
    assert "The runs are of 2 versions of the code: abc, def." in text


def test_a_report_is_written_anew_and_takes_the_place_of_nothing_else(results: Path, tmp_path: Path) -> None:
    out = tmp_path / "report"
    report(results, out)
    before = (out / "index.md").read_bytes()
    report(results, out)
    assert (out / "index.md").read_bytes() == before
    (out / "summary.json").unlink()
    with pytest.raises(UserError, match=r"index\.md.* would be replaced"):
        report(results, out)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--results", "nowhere.csv"], "nowhere.csv has no runs: make some with `envtf compare run`"),
        (["--budget", "cpu-smal"], "no runs of the budget 'cpu-smal': did you mean 'cpu-small'?"),
    ],
)
def test_what_cannot_be_reported_is_said(
    results: Path, words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = words if "--results" in words else [*words, "--results", str(results)]
    with pytest.raises(SystemExit) as stop:
        main(["compare", "report", *given, "--out", str(results.parent / "report")])
    assert stop.value.code == 2
    assert sentence in " ".join(capsys.readouterr().err.split())
    assert not (results.parent / "report").exists()


# published scores


@pytest.mark.parametrize(
    ("algorithm", "means"),
    [  # recomputed by hand, as peers of the paper did
        ("ET", (78.9, 63.1, None, 78.8)),
        ("MOPO", (None, 36.7, None, 40.5)),
        ("RAMBO", (81.8, 65.5, None, 69.8)),
        ("COMBO", (78.4, 64.1, None, None)),
        ("CQL", (67.2, 54.9, None, None)),
        ("IQL", (77.0, None, None, None)),
    ],
)
def test_the_papers_averages_are_over_equal_sets(algorithm: str, means: tuple[float | None, ...]) -> None:
    (column,) = [c for c in published_columns() if (c.publisher, c.algorithm) == (PAPER, algorithm)]
    for tasks, mean in zip(TASK_SETS.values(), means, strict=True):
        if mean is not None:
            assert mean_over(column.scores, tasks) == pytest.approx(mean, abs=0.06)
    assert column.data == ("D4RL -v0" if algorithm == "CQL" else "D4RL -v2")
    if algorithm in ("COMBO", "CQL", "IQL"):
        assert mean_over(column.scores, TASK_SETS["20 tasks"]) is None


def test_published_scores_are_of_our_tasks_and_say_whose_they_are() -> None:
    columns = published_columns()
    assert len(columns) > 25 and len({c.publisher for c in columns}) == 9
    for column in columns:
        assert set(column.scores) <= set(TASKS)
        assert column.data in ("D4RL -v0", "D4RL -v2") and column.measure
        assert all(-10 < score < 160 for score in column.scores.values())
    assert set(TASK_SETS["20 tasks"]) == set(TASKS)
    assert [len(tasks) for tasks in TASK_SETS.values()] == [9, 12, 15, 20]


def test_published_scores_stand_beside_ours(results: Path, tmp_path: Path) -> None:
    report(results, tmp_path / "report")
    text = (tmp_path / "report/index.md").read_text()
    (row,) = [row for row in lines_of(text, "hopper-medium") if len(row) == 8]
    assert row[1:7] == ["67.3", "28.0", "91.2", "94.9", "86.6", "66.3"] and row[7] == "80.0"
    assert "| task | ET, paper (D4RL -v2) | MOPO, paper (D4RL -v2)" in text and "CQL, paper (D4RL -v0)" in text
    assert "ET + CQL, ours, same (zoo, -v5)" in text
    assert "ReBRAC 58.9 of 78.2; IQL 58.0 of 71.4; TD3+BC 46.5 of 69.8" in text


# words


def test_numbers_are_written_as_said() -> None:
    assert page.number(None) == "–" and page.number(-0.04) == "0.0" and page.number(1234.5, 0) == "1,234"
    assert page.spread(Estimate(1.0, None, None, 1)) == "1.0 (1)"
    assert page.spread(Estimate(1.0, -1.0, 3.0, 3)) == "1.0 ± 2.0 (3)"
    assert page.interval(Estimate(0.5, 0.25, 0.75, 3), 2) == "0.50 [0.25, 0.75]"


@pytest.mark.parametrize(
    ("flag", "known"),
    [("--robots", ROBOTS), ("--tiers", TIERS), ("--algorithms", ALGORITHMS), ("--kits", KITS), ("--budget", BUDGETS)],
)
def test_names_that_the_command_line_writes_out_are_all_there_are(
    flag: str, known: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["compare", "run", flag, "?"])
    named = capsys.readouterr().err.partition("choose from")[2]
    assert sorted(re.findall(r"[\w-]+", named)) == sorted(known)
