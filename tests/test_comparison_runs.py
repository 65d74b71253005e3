"""Runs of the comparison for real, on a budget of seconds: in this process, in processes of their own, and on Ray."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from envtf_lit.cli.main import main
from envtf_lit.comparison import cell as cell_module
from envtf_lit.comparison import runner, settings
from envtf_lit.comparison.budgets import budget_of
from envtf_lit.comparison.cell import evaluation_seed, run_cell, section_of
from envtf_lit.comparison.cluster import run_on_ray
from envtf_lit.comparison.grid import Cell, grid
from envtf_lit.comparison.jobs import Job, Outcome, attempt
from envtf_lit.comparison.records import CURVES, DATASET, SHARED, Evaluation, Run, Shared, read_records
from envtf_lit.comparison.runner import run_grid
from envtf_lit.comparison.shared import Home
from envtf_lit.divergence import Diverged
from envtf_lit.errors import UserError
from envtf_lit.policy import load_policy
from envtf_lit.robots.returns import evaluate_policy
from envtf_lit.robots.tasks import ROBOTS
from tests.chores import complain, end_itself, job, sleep_and_note
from tests.made_up_comparison import tiny_networks
from tests.processes import begun

TINY = budget_of("cpu-small", updates=30, episodes=1, transitions=2_000, model_updates=10)
PRESET = settings._preset  # of processes of their own
FLAGS = ["--updates", "30", "--episodes", "1", "--transitions", "2000", "--model-updates", "10"]


@pytest.fixture(scope="module", autouse=True)
def small() -> Iterator[None]:
    """What is trained in this process is of the tiny preset's size, whatever the budget's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(settings, "_preset", tiny_networks)
        yield


def cells_of(*algorithms: str, seeds: Sequence[int] = (0,)) -> list[Cell]:
    return grid(TINY, robots=["hopper"], tiers=["medium"], algorithms=algorithms, kits=["same"], seeds=seeds)


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the dataset of hopper-medium."""
    folder = tmp_path_factory.mktemp("work")
    Home("hopper-medium", TINY, folder).make(DATASET)
    return folder


def in_this_process(jobs: Sequence[Job], workers: int) -> Iterator[tuple[Job, Outcome]]:
    """What `run_jobs` does, without the seconds that each process takes to begin."""
    done = dict[str, bool]()
    for asked in jobs:
        assert all(name in done for name in asked.after)
        outcome = attempt(asked) if all(done[name] for name in asked.after) else Outcome(error="waited in vain")
        done[asked.name] = outcome.error is None
        yield asked, outcome


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "run_jobs", in_this_process)


class Killed(Exception):
    """Stands for a kill, which no test survives."""


# one run


def test_a_run_is_trained_and_scored_as_its_row_says(work: Path) -> None:
    (cell,) = cells_of("wbc")
    run, curve = run_cell(cell, work)
    assert run.key == cell.key
    assert (run.updates, run.episodes, run.score_weighted_bc) == (30, 1, None)
    assert [point.updates for point in curve] == [10, 20, 30] and all(point.run == run.key for point in curve)
    policy = load_policy(Home(cell.task, TINY, work).path / "models/policy" / section_of(cell))
    for shown, seed in ((run.score_final, 0), (curve[-1].score, cell_module.ALONG)):
        played = evaluate_policy(
            policy, ROBOTS["hopper"], episodes=1, seed=evaluation_seed(cell) + seed, progress=False
        )
        assert shown == pytest.approx(played.scores.mean(), abs=1e-3)
    scores = [point.score for point in curve]
    assert run.score_last10 == pytest.approx(sum(scores) / 3, abs=2e-3)
    assert run.score_best == max(*scores, run.score_final)
    assert run.seconds > 0 and run.memory_mb > 100
    again, same = run_cell(cell, work)
    assert (again.score_final, same) == (run.score_final, curve)


def test_episodes_differ_between_training_seeds_data_seeds_and_the_way() -> None:
    cells = [Cell("hopper", "medium", "cql", "same", seed, budget_of("cpu", data_seed=data)) for seed, data in
             ((0, 0), (1, 0), (2, 0), (0, 10), (10, 10))]  # fmt: skip
    bases = [evaluation_seed(cell) for cell in cells]
    played = [range(base + along, base + along + 100) for base in bases for along in (0, cell_module.ALONG)]
    assert len(set().union(*played)) == 100 * len(played)
    assert evaluation_seed(cells[0]) == evaluation_seed(Cell("ant", "random", "bc", "published", 0, cells[0].budget))


def test_a_killed_run_goes_on_from_its_last_evaluation(work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (cell,) = cells_of("cql")
    score, scored = cell_module.score, list[int]()

    def killing(policy: Any, of: Cell, episodes: int, seed: int) -> Any:
        scored.append(seed)
        if len(scored) == 2:
            raise Killed
        return score(policy, of, episodes, seed)

    monkeypatch.setattr(cell_module, "score", killing)
    with pytest.raises(Killed):
        run_cell(cell, work)
    monkeypatch.setattr(cell_module, "score", lambda *given: [scored.append(given[-1]), score(*given)][-1])
    run, curve = run_cell(cell, work)
    assert len(scored) == 2 + 2 + 1  # the first evaluation is not done again: two along the way, and the end
    monkeypatch.undo()
    undisturbed, whole = run_cell(cell, work)
    assert (run.score_final, curve) == (undisturbed.score_final, whole)
    assert run.seconds > 0


def test_a_run_that_diverges_is_scored_by_its_last_sound_policy(work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (cell,) = cells_of("iql")
    whole = run_cell(cell, work)[1]
    check = sys.modules["envtf_lit.training"].check_epoch

    def diverging(*given: Any, **named: Any) -> None:
        if given[3] == 3:
            raise Diverged("IQL diverged in epoch 3")
        check(*given, **named)

    monkeypatch.setattr("envtf_lit.training.check_epoch", diverging)
    run, curve = run_cell(cell, work)
    assert run.updates == 20 and curve == whole[:2]
    assert run.score_final == pytest.approx(curve[-1].score, abs=20.0)  # other episodes of the same policy
    text = Home(cell.task, TINY, work).path / "diverged" / f"{section_of(cell)}.txt"
    assert text.read_text() == "IQL diverged in epoch 3\n"


def test_what_runs_share_is_made_once(work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home, calls = Home("hopper-medium", TINY, work), list[str]()
    assert home.found(DATASET) is not None and home.found("transformer") is None
    for name in ("download", "train_model", "train_policy", "generate_rollouts"):
        function = getattr(sys.modules["envtf_lit.comparison.shared"], name)
        counted = lambda *given, _f=function, _n=name, **named: [calls.append(_n), _f(*given, **named)][-1]  # noqa: E731
        monkeypatch.setattr(f"envtf_lit.comparison.shared.{name}", counted)
    first = home.make("transformer")
    assert home.make("transformer") == first == home.found("transformer")
    home.make("ensemble")
    assert calls == ["train_model", "train_policy", "generate_rollouts", "train_model", "generate_rollouts"]
    (cell,) = cells_of("et_cql")
    assert run_cell(cell, work)[0].updates == 30
    with (home.path / "data/dataset.h5").open("ab") as stream:
        stream.write(b"other bytes")
    assert home.found("transformer") is None


# the grid


def test_a_grid_does_what_is_missing_alone(work: Path, tmp_path: Path, quick: None) -> None:
    results, said = tmp_path / "results.csv", list[str]()
    cells = cells_of("wbc", "cql")
    runs = run_grid(cells, results, work=work, progress=False, report=said.append)
    assert [run.algorithm for run in runs] == ["wbc", "cql"]
    assert runs[1].score_weighted_bc == runs[0].score_final
    assert said[0] == "0 of 2 runs are there" and "min left)" in said[-1] and len(said) == 3
    assert [row.made for row in read_records(results.with_name(SHARED), Shared)] == [DATASET]
    before = results.read_bytes()
    assert run_grid(cells, results, work=work, progress=False, report=said.append) == runs
    assert results.read_bytes() == before
    lines = before.decode().splitlines(keepends=True)
    results.write_text("".join(lines[:2]))  # the row of cql is lost
    run_grid(cells_of("wbc", "cql", "iql"), results, work=work, progress=False, report=said.append)
    assert [line.split(",")[1] for line in said[5:]] == [" cql (same", " iql (same"]
    assert len(read_records(results, Run)) == 3
    assert len(read_records(results.with_name(CURVES), Evaluation)) == 9


def test_a_run_that_fails_leaves_the_others_to_go_on(
    work: Path, tmp_path: Path, quick: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    results, said = tmp_path / "results.csv", list[str]()

    def failing(cell: Cell, where: Path) -> Any:
        if cell.algorithm == "wbc":
            raise UserError("The disk is full: free some.")
        return run_cell(cell, where)

    monkeypatch.setattr(runner, "run_cell", failing)
    cells = cells_of("wbc", "cql")
    with pytest.raises(
        UserError, match=r"1 of 2 jobs failed, the first is hopper-medium, wbc .*: The disk is full: free"
    ):
        run_grid(cells, results, work=work, progress=False, report=said.append)
    assert [run.algorithm for run in read_records(results, Run)] == ["cql"]
    assert "failed: The disk is full: free some." in said[1]
    monkeypatch.undo()
    monkeypatch.setattr(runner, "run_jobs", in_this_process)
    run_grid(cells, results, work=work, progress=False, report=said.append)
    assert [run.algorithm for run in read_records(results, Run)] == ["cql", "wbc"]


def test_nothing_is_begun_over_a_damaged_file_or_with_settings_that_contradict(work: Path, tmp_path: Path) -> None:
    for name in ("results.csv", CURVES, SHARED):
        (tmp_path / name).write_text("mine\n")
        with pytest.raises(UserError, match=f"{name} has the columns mine"):
            run_grid(cells_of("wbc"), tmp_path / "results.csv", work=work, progress=False)
        (tmp_path / name).unlink()
    few = budget_of("cpu-small", updates=10, transitions=2_000)  # too few for the critics before the value gradient
    cell = Cell("hopper", "medium", "et_cql", "same", 0, few)
    assert run_grid([], tmp_path / "results.csv", work=work, progress=False) == []
    assert section_of(cell) == "same-et_cql-0-cpu-small-updates-10-transitions-2000"


# commands


def compare(results: Path, work: Path, *more: str) -> list[str]:
    words = ["--robots", "hopper", "--tiers", "medium", "--kits", "same", "--seeds", "0", "--algorithms", "wbc", "iql"]
    return ["compare", "run", *words, *FLAGS, "--out", str(results), "--work", str(work), "--quiet", *more]


def test_two_algorithms_on_a_task_in_processes(work: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = tmp_path / "results.csv"
    main(compare(results, work, "--workers", "2"))
    said = capsys.readouterr().out
    assert "0 of 2 runs are there" in said and f"--budget '{TINY}'" in said
    runs = read_records(results, Run)
    assert {run.algorithm for run in runs} == {"wbc", "iql"}
    main(["compare", "report", "--results", str(results), "--out", str(tmp_path / "report")])
    assert f"2 runs of {TINY}: {tmp_path}/report/index.md" in capsys.readouterr().out
    assert (tmp_path / "report/curves_same.png").exists()


def wait_for(path: Path, process: subprocess.Popen[str]) -> None:
    """Returns when a process has written a file."""
    while not path.exists():
        assert process.poll() is None
        time.sleep(0.05)


@pytest.mark.slow
def test_a_command_that_is_killed_between_rows_is_gone_on_with(work: Path, tmp_path: Path) -> None:
    results = tmp_path / "results.csv"
    command = [sys.executable, "-m", "envtf_lit", *compare(results, work, "--workers", "1")]
    with begun(command, stdout=subprocess.DEVNULL) as process:
        wait_for(results, process)
        process.kill()
    (first,) = read_records(results, Run)
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "1 of 2 runs are there" in said and f"{first.algorithm} (same" not in said
    assert first in [run for run in read_records(results, Run) if run.algorithm == first.algorithm]
    assert {run.algorithm for run in read_records(results, Run)} == {"wbc", "iql"}


@pytest.mark.slow
def test_an_interrupted_command_keeps_its_rows_and_says_so(work: Path, tmp_path: Path) -> None:
    results = tmp_path / "results.csv"
    command = [sys.executable, "-m", "envtf_lit", *compare(results, work, "--workers", "1")]
    with begun(command, stderr=subprocess.PIPE) as process:
        wait_for(results, process)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=300)
    assert process.returncode == 130
    assert "The same command goes on with the runs that are not finished." in " ".join(said.split())
    assert len(read_records(results, Run)) == 1


# Ray


def test_without_ray_its_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"--ray-address needs Ray .*: pip install 'envtf-lit\[cluster\]'\.$"):
        next(run_on_ray([job(tmp_path, "a", sleep_and_note, tmp_path, "a", 0.0)], "local", 1))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Ray's own
def test_a_local_cluster_of_two_workers_does_the_same(
    work: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("ray")
    results, said = tmp_path / "results.csv", list[str]()
    cells = cells_of("wbc", "cql")
    runs = run_grid(cells, results, work=work, workers=2, ray_address="local", progress=False, report=said.append)
    assert {run.algorithm for run in runs} == {"wbc", "cql"}
    monkeypatch.setattr(settings, "_preset", PRESET)
    alone = [run_cell(cell, work)[0].score_final for cell in cells]
    assert [run.score_final for run in sorted(runs, key=lambda run: run.algorithm != "wbc")] == alone
    jobs = [
        job(tmp_path, "lost", end_itself),
        job(tmp_path, "needs it", sleep_and_note, tmp_path, "x", 0.0, after=("lost",)),
        job(tmp_path, "refused", complain),
        job(tmp_path, "needs that", sleep_and_note, tmp_path, "x", 0.0, after=("refused",)),
        job(tmp_path, "a", sleep_and_note, tmp_path, "a", 0.2),
        job(tmp_path, "b", sleep_and_note, tmp_path, "b", 0.0, after=("a",)),
    ]
    done = {of.name: outcome for of, outcome in run_on_ray(jobs, "local", 2)}
    assert done["lost"].error is not None and done["lost"].error.startswith("Ray lost it: ")
    assert done["needs it"].error is not None
    assert done["refused"].error == "This was asked for."
    assert done["needs that"].error == "refused failed, which it needs"
    assert float((tmp_path / "b").read_text().split()[0]) >= float((tmp_path / "a").read_text().split()[1])
    assert len({done["a"].value, done["b"].value, os.getpid()}) == 3  # a process each
    assert not (tmp_path / "x").exists()
