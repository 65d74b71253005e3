"""What the paper claims, held against made-up runs of which it is known what they say."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import pytest
from made_up_comparison import BUDGET, some_curve, some_run

from envtf_lit.comparison.claims import CLAIMANT, FIRST, Claim, by_interval, claims
from envtf_lit.comparison.findings import standings
from envtf_lit.comparison.grid import KITS
from envtf_lit.comparison.records import Run, Shared
from envtf_lit.comparison.references import PAPER, PRINTED_AVERAGES, TASK_SETS, mean_over, published_columns
from envtf_lit.comparison.statistics import Estimate
from envtf_lit.comparison.view import View
from envtf_lit.robots.tasks import TASKS

ANT = [task for task in TASKS if task.startswith("ant-")]
AHEAD, ON_ANT, FIRSTS, FASTEST, CHEAPER = range(5)
Models = Mapping[str, float]


def grid_of(levels: Mapping[str, float], tasks: Sequence[str], seeds: int, swing: float = 1.0) -> list[Run]:
    """Runs whose scores are a level of the algorithm, a step of the task's, and a step of the seed's."""
    return [
        some_run(task, name, level + place + swing * seed * (-1) ** place, seed=seed)
        for name, level in levels.items()
        for place, task in enumerate(tasks)
        for seed in range(seeds)
    ]


def claims_of(runs: list[Run], reached: Mapping[str, int] | None = None, models: Models | None = None) -> list[Claim]:
    """The claims; each run's curve has its score from the place among four that `reached` has for its algorithm."""
    view = View.of(runs, "same", str(BUDGET))
    places = reached or {}
    curves = [
        point
        for run in runs
        for point in some_curve(run, [run.score_final * (k >= places.get(run.algorithm, 0)) for k in range(4)])
    ]
    shared = [Shared("ant", "medium", str(BUDGET), made, took, 1.0) for made, took in (models or {}).items()]
    return claims(view, standings(view, curves, shared))


ALL = dict.fromkeys(KITS["same"].algorithms, 50.0)


def test_whoever_is_ahead_everywhere_reproduces_everything() -> None:
    runs = grid_of(ALL | {"et_cql": 70.0}, list(TASKS), 3)
    found = claims_of(runs, dict.fromkeys(ALL, 3) | {"et_cql": 1}, {"transformer": 10.0, "ensemble": 30.0})
    assert [claim.verdict for claim in found] == ["reproduces"] * 5
    assert found[AHEAD].found == "+20.0 ± 0.0 over 20 tasks" and found[ON_ANT].found == "ahead on 5 of 5"
    assert found[FIRSTS].found == "on 20 of 20, among 7" and found[CHEAPER].found == "10 s against 30 s"
    assert found[FASTEST].found.startswith("90 % of its score after 50% of the updates; ")


def test_whoever_is_behind_everywhere_reproduces_nothing() -> None:
    runs = grid_of(ALL | {"et_cql": 30.0}, list(TASKS), 3)
    found = claims_of(runs, {"et_cql": 3}, {"transformer": 30.0, "ensemble": 10.0})
    assert [claim.verdict for claim in found] == ["does not"] * 5


def test_one_seed_leaves_ant_open_and_many_tasks_speak_without_it() -> None:
    levels = {"wbc": 40.0, "cql": 50.0, "et_cql": 60.0}
    runs = [replace(run, score_final=run.score_final + 5 * (run.tier == "medium") * (run.algorithm == "et_cql"))
            for run in grid_of(levels, list(TASKS)[:8] + ANT[:2], 1)]  # fmt: skip
    found = claims_of(runs)
    assert found[AHEAD].verdict == "reproduces" and found[AHEAD].found.endswith("over 10 tasks")
    assert (found[ON_ANT].verdict, found[ON_ANT].found) == ("open", "ahead on 2 of 2")
    assert found[ON_ANT].why == "2 of 5 tasks; too few seeds for a clear lead"
    assert (found[FIRSTS].verdict, found[FIRSTS].why) == ("open", "4 of the kit's algorithms have too few runs")
    assert found[FASTEST].verdict == found[CHEAPER].verdict == "open"


def test_behind_by_less_than_seeds_may_do_is_open() -> None:
    scores = {"cql": (40.0, 60.0, 50.0), "et_cql": (55.0, 44.0, 48.0)}
    runs = [some_run(ANT[0], name, score, seed=seed) for name, row in scores.items() for seed, score in enumerate(row)]
    claim = claims_of(runs)[ON_ANT]
    assert claim.verdict == "open" and claim.why.startswith("behind on 1, within what seeds may do; 1 of 5 tasks")


@pytest.mark.parametrize(("tasks", "verdict"), [(20 - FIRST, "open"), (20 - FIRST + 1, "does not")])
def test_a_count_is_settled_once_the_missing_tasks_cannot_turn_it(tasks: int, verdict: str) -> None:
    runs = grid_of(ALL | {"cql": 60.0}, list(TASKS)[:tasks], 1)
    claim = claims_of(runs)[FIRSTS]
    assert (claim.found, claim.verdict) == (f"on 0 of {tasks}, among 7", verdict)


@pytest.mark.parametrize("algorithms", [["cql"], ["et_cql"], ["wbc", "cql"]])
def test_without_the_method_or_another_all_is_open(algorithms: list[str]) -> None:
    found = claims_of(grid_of(dict.fromkeys(algorithms, 50.0), ANT, 2))
    assert [claim.verdict for claim in found] == ["open"] * 5
    assert all(claim.found == "–" and claim.why for claim in found)


def test_a_verdict_needs_an_interval_that_leaves_zero_out() -> None:
    cases = {(None, None): "open", (0.1, 2.0): "reproduces", (-2.0, -0.1): "does not", (-1.0, 1.0): "open"}
    assert {(low, high): by_interval(Estimate(0.5, low, high, 3))[0] for low, high in cases} == cases


def test_the_papers_numbers_are_its_own() -> None:
    columns = {column.algorithm: column for column in published_columns() if column.publisher == PAPER}
    assert columns.keys() == PRINTED_AVERAGES.keys() and CLAIMANT.keys() == KITS.keys()
    for name, column in columns.items():
        assert mean_over(column.scores, column.scores) == pytest.approx(PRINTED_AVERAGES[name], abs=0.06)
    best = [
        max((c for c in columns.values() if task in c.scores), key=lambda c: c.scores[task]).algorithm
        for task in TASK_SETS["20 tasks"]
    ]
    assert best.count("ET") == FIRST
