"""The comparison's grid, budgets and settings, and the files that are its state."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import pytest

from envtf_lit.agents.options import NO_WORLD_MODEL
from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.comparison import records
from envtf_lit.comparison.budgets import BUDGETS, budget_of, epoch_of, read_budget
from envtf_lit.comparison.grid import CLAIMANTS, KITS, Cell, grid
from envtf_lit.comparison.records import CURVES, SHARED, Evaluation, Run, Shared, add_run, add_shared, read_records
from envtf_lit.comparison.settings import cell_params, policy_options, shared_params
from envtf_lit.errors import UserError
from envtf_lit.pipeline.published import published_options
from envtf_lit.pipeline.yaml import preset_params
from tests.made_up_comparison import BUDGET, some_curve, some_run

COLUMNS = (
    "robot,tier,algorithm,kit,seed,budget,updates,score_final,score_last10,score_best,score_weighted_bc,episodes,"
    "seconds,memory_mb,device,commit"
)


def cell(algorithm: str, kit: str = "same", task: str = "hopper-medium", budget: str = "cpu-small") -> Cell:
    robot, _, tier = task.partition("-")
    return Cell(robot, tier, algorithm, kit, 0, budget_of(budget))


# budgets


def test_the_smallest_budget_is_ten_thousand_updates_of_everything() -> None:
    assert (BUDGET.updates, BUDGET.episodes, BUDGET.curve_episodes) == (10_000, 20, 5)
    assert BUDGET.updates // BUDGET.updates_per_epoch == 20
    for algorithm in ALGORITHMS:
        for kit in KITS:
            assert policy_options(cell(algorithm, kit)).updates == 10_000


def test_a_budgets_text_makes_it_again() -> None:
    changes = dict(updates=20, episodes=1, transitions=2_000, model_updates=20, data_share=0.5, data_seed=10)
    for budget in (*BUDGETS.values(), budget_of("cpu-small", **changes), budget_of("paper", data_share=0.1)):
        assert read_budget(str(budget)) == budget
    assert [str(budget) for budget in BUDGETS.values()] == list(BUDGETS)
    assert str(budget_of("gpu", data_share=0.1)) == "gpu data_share=0.1"
    assert budget_of("gpu", data_share=0.1).rows == 20_000


@pytest.mark.parametrize(
    "text", ["gpu updates", "gpu data_share=1.0", "gpu rows=3", "gpu updates=x", "gpu  ", "cpu-smal"]
)
def test_what_is_no_budgets_text_is_refused(text: str) -> None:
    with pytest.raises(UserError):
        read_budget(text)


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("cpu-smal", {}, "did you mean 'cpu-small'"),
        ("cpu", {"updates": 8}, "--updates is 8: take a multiple of 10"),
        ("cpu", {"data_share": 0.0}, "--data-share is 0: give a number above 0, and at most 1"),
        ("cpu", {"data_share": 1.5}, "--data-share is 1.5"),
        ("cpu", {"data_share": float("nan")}, "--data-share is nan"),
        ("cpu", {"episodes": 0}, "--episodes is 0: give a whole number above 0"),
    ],
)
def test_numbers_out_of_range_are_refused(name: str, changes: dict[str, float], words: str) -> None:
    with pytest.raises(UserError, match=words):
        budget_of(name, **changes)


def test_epochs_are_whole_and_no_shorter_than_asked() -> None:
    assert epoch_of(10_000, 500, 10) == 500
    assert epoch_of(60, 3, 10) == 10
    assert epoch_of(70, 20, 10) == 70  # 20 to 60 leave a rest
    assert epoch_of(7, 2) == 7


# the grid


def test_the_whole_grid_is_the_issues() -> None:
    cells = grid(BUDGET)
    assert len(cells) == len({found.key for found in cells}) == 20 * 10 + 20 * 7 * 3
    first = [found for found in cells if found.seed == 0]
    assert cells[: len(first)] == first  # the first seed of everything
    rest = cells[len(first) :]
    claimed = [found for found in rest if found.algorithm in CLAIMANTS]
    assert rest[: len(claimed)] == claimed  # then the seeds that claims rest on
    assert [found.task for found in cells[:17]] == ["hopper-random"] * 17  # a task is finished before the next is begun


def test_a_part_of_the_grid_is_chosen_by_names() -> None:
    cells = grid(BUDGET, robots=["ant"], tiers=["medium"], algorithms=["cql", "cql", "bc"], kits=["same"], seeds=[4, 3])
    assert [(found.algorithm, found.seed) for found in cells] == [("cql", 4), ("bc", 4), ("cql", 3), ("bc", 3)]


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ({"robots": ["hoper"]}, "Unknown robot 'hoper': did you mean 'hopper'"),
        ({"tiers": ["medium-relay"]}, "Unknown tier 'medium-relay': did you mean 'medium-replay'"),
        ({"algorithms": ["cqll"]}, "Unknown algorithm 'cqll': did you mean 'cql'"),
        ({"kits": ["sane"]}, "Unknown kit 'sane': did you mean 'same'"),
    ],
)
def test_unknown_names_are_refused_with_the_nearest(names: dict[str, list[str]], words: str) -> None:
    with pytest.raises(UserError, match=words):
        grid(BUDGET, **names)  # pyright: ignore[reportArgumentType]


def test_a_seed_that_is_named_twice_is_refused() -> None:
    with pytest.raises(UserError, match="Seed 3 is named twice, which is the same run"):
        grid(BUDGET, seeds=[3, 1, 3])


# settings


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_same_kit_shares_all_that_is_common_but_the_algorithm(algorithm: str) -> None:
    common, options = asdict(preset_params("small").policy), asdict(policy_options(cell(algorithm)))
    own = {"updates": 10_000, "updates_per_epoch": 500}
    assert {name: options[name] for name in common} == common | own


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_as_published_is_the_tasks_row_but_for_its_length(algorithm: str) -> None:
    own = {"rambo": ("warm_start",), "et_cql": ("critic_updates", "value_gradient")}  # numbers of updates
    for task in ("hopper-medium-replay", "ant-full-replay"):
        published = asdict(published_options(algorithm, task))
        options = asdict(policy_options(cell(algorithm, "published", task)))
        changed = {name for name in options if options[name] != published[name]}
        assert changed <= {"updates", "updates_per_epoch", *own.get(algorithm, ())}


def test_a_published_number_of_updates_before_all_others_keeps_its_share() -> None:
    published, options = published_options("rambo", "hopper-medium"), policy_options(cell("rambo", "published"))
    assert published.warm_start == 50_000
    assert options.warm_updates == round(10_000 * 50_000 / published.updates) == 244


@pytest.mark.parametrize("budget", BUDGETS)
def test_the_settings_of_all_runs_go_with_their_world_models(budget: str) -> None:
    for kit in KITS:
        for algorithm in ALGORITHMS:
            params = cell_params(cell(algorithm, kit, "walker2d-medium", budget), "run")
            model = params.train_policy["run"].world_model
            assert (params.threads, params.seed, params.compile) == (1, 0, False)
            assert ALGORITHMS[algorithm].imagines == (model != NO_WORLD_MODEL)
            assert model in (NO_WORLD_MODEL, *params.train_model)


def test_runs_share_the_dataset_and_the_world_models_whatever_their_seed() -> None:
    seeds = [Cell("hopper", "medium", "cql", "same", seed, budget_of("cpu", data_seed=12)) for seed in (0, 1)]
    params = [cell_params(found, "run") for found in seeds]
    assert [found.seed for found in params] == [0, 1]
    assert shared_params("hopper-medium", seeds[0].budget).seed == 12
    assert params[0].train_model == params[1].train_model


def test_world_models_have_the_budgets_updates_and_the_papers_is_its_own() -> None:
    small = shared_params("hopper-medium", BUDGET)
    assert small.train_model["transformer"] == preset_params("small").train_model["transformer"]
    assert small.download.transitions == 100_000
    assert shared_params("hopper-medium", BUDGET, "ensemble").train_model["ensemble"].updates == 6_000
    paper = cell_params(cell("et_cql_paper", "published", budget="paper"), "run")
    assert paper.train_policy["run"].world_model == "paper"
    assert paper.train_model["paper"] == preset_params("paper").train_model["transformer"]
    assert cell_params(cell("et_cql", budget="paper"), "run").train_policy["run"].world_model == "transformer"


# the files


def test_a_row_has_the_issues_columns_and_is_read_as_it_was_written(tmp_path: Path) -> None:
    results, run = tmp_path / "results.csv", some_run(score=50.123)
    add_run(results, run, some_curve(run, [10.0, 50.0]))
    assert results.read_text().splitlines()[0] == COLUMNS
    assert read_records(results, Run) == [run]
    assert [point.updates for point in read_records(results.with_name(CURVES), Evaluation)] == [5_000, 10_000]
    shared = Shared("hopper", "medium", str(BUDGET), "dataset", 20.0, 500.0, 100_000, 300, 10.0, 60.0)
    add_shared(results, shared)
    add_shared(results, shared)
    assert read_records(results.with_name(SHARED), Shared) == [shared]
    assert sorted(path.name for path in tmp_path.glob("[!.]*")) == [CURVES, "results.csv", SHARED]


def test_a_run_that_is_there_stays(tmp_path: Path) -> None:
    results, first, again = tmp_path / "results.csv", some_run(score=50.0), some_run(score=60.0)
    add_run(results, first, some_curve(first, [50.0]))
    add_run(results, again, some_curve(again, [60.0]))
    assert [run.score_final for run in read_records(results, Run)] == [50.0]
    assert [point.score for point in read_records(results.with_name(CURVES), Evaluation)] == [50.0]


def test_rows_are_completed_with_the_weighted_bc_of_their_kit_and_seed(tmp_path: Path) -> None:
    results = tmp_path / "results.csv"
    others = [
        some_run(algorithm="cql"),
        some_run(algorithm="cql", seed=1),
        some_run(algorithm="cql", kit="published"),
        some_run(algorithm="cql", task="hopper-random"),
        some_run(algorithm="cql", budget=budget_of("cpu")),
    ]
    for run in (*others, some_run(algorithm="wbc", score=30.0), some_run(algorithm="iql")):
        add_run(results, run, [])
    found = {run.key: run.score_weighted_bc for run in read_records(results, Run)}
    assert [found[run.key] for run in others] == [30.0, None, None, None, None]
    assert found[some_run(algorithm="iql").key] == found[some_run(algorithm="wbc").key] == 30.0


def test_a_kill_between_the_curve_and_the_row_leaves_nothing_half_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results, first, second = tmp_path / "results.csv", some_run(), some_run(seed=1)
    add_run(results, first, some_curve(first, [1.0]))
    before = results.read_bytes()

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(records, "with_weighted_bc", killed)
    with pytest.raises(KeyboardInterrupt):
        add_run(results, second, some_curve(second, [2.0, 3.0]))
    monkeypatch.undo()
    assert results.read_bytes() == before
    add_run(results, second, some_curve(second, [4.0]))
    assert [run.seed for run in read_records(results, Run)] == [0, 1]
    assert [point.score for point in read_records(results.with_name(CURVES), Evaluation)] == [1.0, 4.0]


def test_a_full_disk_leaves_the_rows_that_were_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = tmp_path / "results.csv"
    add_run(results, some_run(), [])
    before = results.read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(UserError, match="No space left"):
        add_run(results, some_run(seed=1), [])
    assert results.read_bytes() == before


def test_rows_that_are_added_at_once_are_all_kept(tmp_path: Path) -> None:
    results, runs = tmp_path / "results.csv", [some_run(seed=seed) for seed in range(12)]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda run: add_run(results, run, some_curve(run, [1.0])), runs))
    assert sorted(run.seed for run in read_records(results, Run)) == list(range(12))
    assert len(read_records(results.with_name(CURVES), Evaluation)) == 12


GOOD = "hopper,medium,cql,same,0,cpu-small,10000,50.0,48.0,54.0,,20,100.0,700.0,cpu,abc"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no columns"),
        ("a,b\n1,2\n", "has the columns a, b, where robot, tier"),
        (f"{COLUMNS}\n{GOOD}\n{GOOD}\n", "line 3: the same as in an earlier line"),
        (f"{COLUMNS}\n{GOOD[:42]}\n", "line 2: 8 values, and there are 16 columns"),
        (f"{COLUMNS}\n{GOOD.replace('50.0', 'fifty')}\n", "line 2: score_final is 'fifty', expected a number"),
        (f"{COLUMNS}\n{GOOD.replace('50.0', 'nan')}\n", "line 2: score_final is 'nan', expected a number"),
        (f"{COLUMNS}\n{GOOD.replace('10000', '1e4')}\n", "line 2: updates is '1e4', expected a whole number"),
        (f"{COLUMNS}\n{GOOD.replace('hopper', 'hoper')}\n", "line 2: Unknown robot 'hoper': did you mean 'hopper'"),
        (f"{COLUMNS}\n{GOOD.replace('cpu-small', 'cpu-smal')}\n", "line 2: Unknown budget"),
        (f"{COLUMNS}\n{GOOD.replace('abc', '')}\n", "line 2: commit is empty"),
        (f'{COLUMNS}\n"{GOOD}\n', "is no CSV file"),
        (f"{COLUMNS}\n\xff".encode("latin-1"), "is no CSV file"),
    ],
)
def test_damaged_and_foreign_files_are_refused_and_stay(tmp_path: Path, text: str | bytes, words: str) -> None:
    results = tmp_path / "results.csv"
    results.write_bytes(text if isinstance(text, bytes) else text.encode())
    before = results.read_bytes()
    for act in (lambda: read_records(results, Run), lambda: add_run(results, some_run(seed=7), [])):
        with pytest.raises(UserError, match=words) as caught:
            act()
        assert str(results) in str(caught.value) and "Put the file back as it was, or move it away." in str(
            caught.value
        )
    assert results.read_bytes() == before


def test_rows_of_algorithms_that_are_no_more_are_kept(tmp_path: Path) -> None:
    results = tmp_path / "results.csv"
    results.write_text(f"{COLUMNS}\n{GOOD.replace('cql', 'long_gone')}\n")
    add_run(results, some_run(), [])
    assert [run.algorithm for run in read_records(results, Run)] == ["long_gone", "cql"]
