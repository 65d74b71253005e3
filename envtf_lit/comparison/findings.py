"""What the runs of one kit say: who is first and by how much, who does harm, how fast, and at what cost."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median

import numpy as np

from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.comparison.budgets import Budget, read_budget
from envtf_lit.comparison.grid import KITS, WEIGHTED_BC, Cell, Key, grid
from envtf_lit.comparison.records import DATASET, Evaluation, Run, Shared
from envtf_lit.comparison.settings import policy_options
from envtf_lit.comparison.statistics import (
    Difference,
    Estimate,
    interquartile_mean,
    paired_difference,
    probability_of_improvement,
)
from envtf_lit.comparison.view import View

REACHED = 0.9  # of the final score, whose updates are counted
TOLERATED = 0.9  # of the yardstick, below which a run did harm
BASES = ("cql", WEIGHTED_BC)  # that the others are compared with, run by run


@dataclass(frozen=True)
class Log:
    """What the recorded episodes of a task's dataset score.

    Attributes:
        mean: of the episodes.
        best: of them.
    """

    mean: float
    best: float


def logs(shared: Iterable[Shared], budget: str) -> dict[str, Log]:
    """The datasets by task, those of other budgets left out."""
    return {
        f"{row.robot}-{row.tier}": Log(row.score_mean, row.score_best)
        for row in shared
        if row.made == DATASET and row.budget == budget and row.score_mean is not None and row.score_best is not None
    }


@dataclass(frozen=True)
class Standing:
    """What is said of one algorithm of a kit.

    Attributes:
        runs: how many there are, of all tasks and seeds.
        iqm: interquartile mean of the final scores of the common runs; None of what is not compared.
        iqm_last10: likewise of the means of the last ten evaluations.
        mean: over the common tasks of the mean over seeds.
        best: likewise of the best checkpoints.
        worst: the run of lowest final score.
        first_alone: tasks, of those that count, on which its mean is the highest, to the decimal.
        above_log: tasks on which its mean is above the best recorded episode, and tasks whose log is known.
        improvement: by base, chance to score higher; None without common runs.
        difference: by base, likewise.
        reached: median updates after which a run had 90 % of its final score, as a share of all; None without curves.
        seconds: median of the training.
        memory_mb: the most of any run.
        model_seconds: median over tasks of what making its world model took; None where it has none, or none is noted.
    """

    runs: int
    iqm: Estimate | None
    iqm_last10: Estimate | None
    mean: float | None
    best: float | None
    worst: Run
    first_alone: int
    above_log: tuple[int, int]
    improvement: Mapping[str, Estimate]
    difference: Mapping[str, Difference]
    reached: float | None
    seconds: float
    memory_mb: float
    model_seconds: float | None


def standings(view: View, curves: Iterable[Evaluation], shared: Sequence[Shared]) -> dict[str, Standing]:
    """What is said of each algorithm of a kit, by name."""
    points = dict[Key, list[Evaluation]]()
    for point in curves:
        points.setdefault(point.run, []).append(point)
    known, firsts = logs(shared, view.budget), first_alone(view)
    return {name: _standing(view, name, points, shared, known, firsts.count(name)) for name in view.algorithms}


def _standing(
    view: View,
    name: str,
    points: Mapping[Key, list[Evaluation]],
    shared: Sequence[Shared],
    known: Mapping[str, Log],
    firsts: int,
) -> Standing:
    runs = [run for run in view.runs if run.algorithm == name]
    cells = view.common if name in view.compared else {}
    bases = {base: view.shared_by([name, base]) for base in BASES if base in view.algorithms and base != name}
    pairs = {base: (view.samples(name, both), view.samples(base, both)) for base, both in bases.items() if both}
    reached = [share for run in runs if (share := updates_to_reach(run, points.get(run.run, []))) is not None]
    models = [row.seconds for row in shared if row.budget == view.budget and row.made == model_of(runs[0])]
    return Standing(
        runs=len(runs),
        iqm=interquartile_mean(view.samples(name, cells)) if cells else None,
        iqm_last10=interquartile_mean(view.samples(name, cells, "score_last10")) if cells else None,
        mean=_mean(view.samples(name, cells)),
        best=_mean(view.samples(name, cells, "score_best")),
        worst=min(runs, key=lambda run: run.score_final),
        first_alone=firsts,
        above_log=above_log(view, name, known),
        improvement={base: probability_of_improvement(*pair) for base, pair in pairs.items()},
        difference={base: paired_difference(*pair) for base, pair in pairs.items()},
        reached=median(reached) if reached else None,
        seconds=median(run.seconds for run in runs),
        memory_mb=max(run.memory_mb for run in runs),
        model_seconds=median(models) if models else None,
    )


def _mean(samples: Sequence[np.ndarray]) -> float | None:
    return fmean(float(scores.mean()) for scores in samples) if samples else None


def first_alone(view: View) -> list[str]:
    """The algorithm of highest mean of each common task, to the decimal; tasks with two firsts have none."""
    firsts = []
    for task, seeds in view.common.items() if len(view.compared) > 1 else ():
        means = {name: round(float(view.samples(name, {task: seeds})[0].mean()), 1) for name in view.compared}
        first = [name for name in means if means[name] == max(means.values())]
        firsts += first if len(first) == 1 else []
    return firsts


def above_log(view: View, name: str, known: Mapping[str, Log]) -> tuple[int, int]:
    """Tasks on which an algorithm's mean is above the best recorded episode, and tasks that can be judged."""
    judged = [task for task in view.tasks if task in known and view.seeds(name, task)]
    return sum(float(view.scores(name, task).mean()) > known[task].best for task in judged), len(judged)


def updates_to_reach(run: Run, curve: Sequence[Evaluation]) -> float | None:
    """The share of a run's updates after which an evaluation first had 90 % of its final score.

    None where no evaluation had, or the final score is not above zero, of which 90 % would mean nothing.
    """
    reached = [point.updates for point in curve if point.score >= REACHED * run.score_final]
    return min(reached) / run.updates if reached and run.score_final > 0 and run.updates else None


def model_of(run: Run) -> str | None:
    """The world model that a run imagined in, by name; None of an algorithm that is no more."""
    if run.algorithm not in ALGORITHMS:
        return None
    return policy_options(cell_of(run)).world_model


def cell_of(run: Run) -> Cell:
    """The cell of the grid that a run is of."""
    return Cell(run.robot, run.tier, run.algorithm, run.kit, run.seed, read_budget(run.budget))


@dataclass(frozen=True)
class Harm:
    """A run that does worse than it may.

    Attributes:
        run: its row.
        yardstick: the larger score of weighted BC and of the data's mean episode, as far as they are known.
    """

    run: Run
    yardstick: float


def harm(view: View, known: Mapping[str, Log]) -> tuple[list[Harm], int]:
    """The runs below 90 % of their yardstick, and the number that could be judged, weighted BC itself left out.

    A tenth of the yardstick's size is what may be missing, so that it is below one that is negative, too.
    """
    harmful, judged = list[Harm](), 0
    for run in view.runs:
        log = known.get(f"{run.robot}-{run.tier}")
        scores = [run.score_weighted_bc, None if log is None else log.mean]
        given = [score for score in scores if score is not None]
        if run.algorithm == WEIGHTED_BC or not given:
            continue
        judged += 1
        yardstick = max(given)
        if run.score_final < yardstick - (1.0 - TOLERATED) * abs(yardstick):
            harmful.append(Harm(run, yardstick))
    return sorted(harmful, key=lambda found: found.run.score_final - found.yardstick), judged


def missing(view: View, budget: Budget) -> list[Cell]:
    """The runs of the kit's whole plan, and of what else was begun, that are not there.

    What else was begun are further algorithms and seeds, each on all tasks of the plan.
    """
    plan = KITS[view.kit]
    algorithms = dict.fromkeys([*plan.algorithms, *(name for name in view.algorithms if name in ALGORITHMS)])
    seeds = dict.fromkeys([*plan.seeds, *sorted({run.seed for run in view.runs})])
    cells = grid(budget, algorithms=list(algorithms), kits=[view.kit], seeds=list(seeds))
    there = {run.run for run in view.runs}
    return [cell for cell in cells if cell.key not in there]


def early(view: View) -> list[Run]:
    """Runs whose training diverged before its last update."""
    return [run for run in view.runs if run.updates < read_budget(run.budget).updates]
