"""Made-up files of a comparison, whose numbers are known; and the networks of its runs for real, which are tiny."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

from envtf_lit.comparison.budgets import Budget, budget_of
from envtf_lit.comparison.records import DATASET, Evaluation, Run, Shared, add_run, add_shared
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.yaml import preset_params

BUDGET = budget_of("cpu-small")


def some_run(
    task: str = "hopper-medium",
    algorithm: str = "cql",
    score: float = 50.0,
    *,
    seed: int = 0,
    kit: str = "same",
    budget: Budget = BUDGET,
    updates: int | None = None,
    seconds: float = 100.0,
    commit: str = "abc",
) -> Run:
    """A run; its last ten evaluations score 2 less than its end, the best 4 more."""
    robot, _, tier = task.partition("-")
    return Run(
        robot, tier, algorithm, kit, seed, str(budget),
        updates=budget.updates if updates is None else updates,
        score_final=score,
        score_last10=score - 2.0,
        score_best=score + 4.0,
        score_weighted_bc=None,
        episodes=20,
        seconds=seconds,
        memory_mb=700.0,
        device="cpu (x86_64)",
        commit=commit,
    )  # fmt: skip


def some_curve(run: Run, scores: Sequence[float]) -> list[Evaluation]:
    """Evaluations after equal numbers of updates, the last after all of them."""
    steps = [run.updates * (1 + index) // len(scores) for index in range(len(scores))]
    return [Evaluation(*run.key, updates=n, score=score) for n, score in zip(steps, scores, strict=True)]


def write_comparison(results: Path, runs: Iterable[Run], logs: dict[str, tuple[float, float]] | None = None) -> None:
    """The three files.

    Args:
        results: CSV of the runs.
        runs: each climbs to its score in four even steps.
        logs: mean and best score of the datasets, by task.
    """
    for run in runs:
        add_run(results, run, some_curve(run, [run.score_final * share for share in (0.25, 0.5, 0.75, 1.0)]))
    for task, (mean, best) in (logs or {}).items():
        robot, _, tier = task.partition("-")
        add_shared(results, Shared(robot, tier, str(BUDGET), DATASET, 20.0, 500.0, 100_000, 300, mean, best))
        add_shared(results, Shared(robot, tier, str(BUDGET), "transformer", 220.0, 900.0))


@cache
def tiny_networks(_: str) -> Params:
    """In place of any preset of the comparison: the tiny one, with updates enough for every algorithm's phases."""
    tiny = preset_params("tiny")
    return replace(tiny, policy=replace(tiny.policy, updates=4_500, updates_per_epoch=500))
