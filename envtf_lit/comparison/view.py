"""The runs of one kit at one budget, by algorithm and task, and the part of them that compares like with like."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.comparison.budgets import read_budget
from envtf_lit.comparison.grid import KITS
from envtf_lit.comparison.records import Run
from envtf_lit.robots.tasks import TASKS

LEAST = 0.5  # an algorithm with a smaller share of the most runs that one has is not compared with the others


def label_of(algorithm: str) -> str:
    """What tables and figures call an algorithm; its name, of one that is no more."""
    return ALGORITHMS[algorithm].label if algorithm in ALGORITHMS else algorithm


@dataclass(frozen=True, eq=False)
class View:
    """Runs of one kit and budget.

    Attributes:
        kit: by name.
        budget: its text.
        by_run: each run, by algorithm, task and seed.
    """

    kit: str
    budget: str
    by_run: Mapping[tuple[str, str, int], Run]

    @classmethod
    def of(cls, runs: Iterable[Run], kit: str, budget: str) -> "View":
        """Those among all runs."""
        chosen = [run for run in runs if (run.kit, run.budget) == (kit, budget)]
        return cls(kit, budget, {(run.algorithm, f"{run.robot}-{run.tier}", run.seed): run for run in chosen})

    @property
    def runs(self) -> list[Run]:
        """All of them."""
        return list(self.by_run.values())

    @cached_property
    def algorithms(self) -> list[str]:
        """Those that have runs, in the kit's order, others behind."""
        found = {algorithm for algorithm, _, _ in self.by_run}
        return [name for name in KITS[self.kit].algorithms if name in found] + sorted(
            found - {*KITS[self.kit].algorithms}
        )

    @cached_property
    def tasks(self) -> list[str]:
        """Those that have runs, in the order of the twenty."""
        found = {task for _, task, _ in self.by_run}
        return [task for task in TASKS if task in found]

    def seeds(self, algorithm: str, task: str) -> list[int]:
        """Of the runs of an algorithm on a task."""
        return sorted(seed for name, of, seed in self.by_run if (name, of) == (algorithm, task))

    def scores(self, algorithm: str, task: str, column: str = "score_final") -> np.ndarray:
        """(n,) of the seeds, in their order."""
        runs = (self.by_run[algorithm, task, seed] for seed in self.seeds(algorithm, task))
        return np.array([getattr(run, column) for run in runs])

    @cached_property
    def compared(self) -> list[str]:
        """The algorithms that have runs enough to be compared with the others."""
        counts = {name: sum(algorithm == name for algorithm, _, _ in self.by_run) for name in self.algorithms}
        return [name for name in self.algorithms if counts[name] >= LEAST * max(counts.values())]

    @cached_property
    def common(self) -> dict[str, list[int]]:
        """Seeds by task that all the compared algorithms have."""
        return self.shared_by(self.compared)

    def shared_by(self, algorithms: Sequence[str]) -> dict[str, list[int]]:
        """Seeds by task that all of these have; tasks without any are left out."""
        found = {}
        for task in self.tasks:
            seeds = set.intersection(*(set(self.seeds(name, task)) for name in algorithms)) if algorithms else set()
            if seeds:
                found[task] = sorted(seeds)
        return found

    def samples(
        self, algorithm: str, cells: Mapping[str, Sequence[int]], column: str = "score_final"
    ) -> list[np.ndarray]:
        """Scores (seeds,) of each task of some cells, all of which the algorithm has."""
        return [
            np.array([getattr(self.by_run[algorithm, task, seed], column) for seed in seeds])
            for task, seeds in cells.items()
        ]


def with_data(budget: str, runs: Iterable[Run]) -> list[str]:
    """The budgets' texts among runs that differ from a budget in the share of the data alone, the smallest first."""
    shares = {text: _share(text, budget) for text in {run.budget for run in runs}}
    return sorted((text for text, share in shares.items() if share is not None), key=lambda text: shares[text] or 0.0)


def _share(text: str, budget: str) -> float | None:
    other, this = read_budget(text), read_budget(budget)
    return other.data_share if replace(other, data_share=this.data_share) == this else None
