"""The grid: which runs there are to do, and in which order."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.comparison.budgets import Budget
from envtf_lit.errors import UserError, did_you_mean
from envtf_lit.robots.tasks import ROBOTS, TIERS, Robot

Kit = Literal["published", "same"]
Key = tuple[str, str, str, str, int, str]  # robot, tier, algorithm, kit, seed, budget: what names a run

WEIGHTED_BC = "wbc"  # the algorithm that others must not fall below
CLAIMANTS = ("et_cql", "cql", WEIGHTED_BC)  # whose further seeds matter most: claims are about their differences


@dataclass(frozen=True)
class Plan:
    """What a kit is made for.

    Attributes:
        algorithms: in the order of tables.
        seeds: of the training.
        meaning: in words.
    """

    algorithms: tuple[str, ...]
    seeds: tuple[int, ...]
    meaning: str


KITS: dict[str, Plan] = {
    "published": Plan(
        ("bc", "td3_bc", "rebrac", "iql", "cql", "mopo", "combo", "rambo", "mobile", "et_cql_paper"),
        (0,),
        "each algorithm with the settings that were published for the task",
    ),
    "same": Plan(
        (WEIGHTED_BC, "rebrac", "iql", "cql", "combo", "mobile", "et_cql"),
        (0, 1, 2),
        "rows, warm start, discount, n-step, networks and rates shared by all, so that only the algorithm differs",
    ),
}


@dataclass(frozen=True)
class Cell:
    """One run of the grid.

    Attributes:
        robot: by name.
        tier: of its data.
        algorithm: by its name in the registry.
        kit: whose settings: `published` for the task, or the `same` for all.
        seed: of the training; data and world models have the budget's.
        budget: what it may spend.
    """

    robot: str
    tier: str
    algorithm: str
    kit: str
    seed: int
    budget: Budget

    @property
    def task(self) -> str:
        """Robot and tier, such as `hopper-medium`."""
        return f"{self.robot}-{self.tier}"

    @property
    def machine(self) -> Robot:
        """The robot itself."""
        return ROBOTS[self.robot]

    @property
    def key(self) -> Key:
        """What no two rows of results have in common."""
        return (self.robot, self.tier, self.algorithm, self.kit, self.seed, str(self.budget))

    def __str__(self) -> str:
        return f"{self.task}, {self.algorithm} ({self.kit}, seed {self.seed})"


def grid(
    budget: Budget,
    *,
    robots: Iterable[str] = ROBOTS,
    tiers: Iterable[str] = TIERS,
    algorithms: Sequence[str] | None = None,
    kits: Iterable[str] = KITS,
    seeds: Sequence[int] | None = None,
) -> list[Cell]:
    """All runs, the most telling first: whoever stops early lacks seeds of baselines, then seeds, and tasks last.

    The first seed of everything comes first, then further seeds of `CLAIMANTS`, then those of the others.

    Args:
        budget: of each.
        robots, tiers: by name.
        algorithms: None for the kit's own.
        kits: by name.
        seeds: None for the kit's own.

    Raises:
        UserError: an unknown name, with the nearest known one, or a seed that is named twice.
    """
    twice = next((seed for seed, count in Counter(seeds or ()).items() if count > 1), None)
    if twice is not None:
        raise UserError(f"Seed {twice} is named twice, which is the same run: give further seeds, each once.")
    chosen = [(kit, KITS[known("kit", kit, KITS)]) for kit in dict.fromkeys(kits)]
    cells = [
        Cell(known("robot", robot, ROBOTS), known("tier", tier, TIERS), algorithm, kit, seed, budget)
        for robot in dict.fromkeys(robots)
        for tier in dict.fromkeys(tiers)
        for kit, plan in chosen
        for algorithm in dict.fromkeys(algorithms or plan.algorithms)
        for seed in seeds or plan.seeds
        if known("algorithm", algorithm, ALGORITHMS)
    ]
    first = {kit: (seeds or plan.seeds)[0] for kit, plan in chosen}
    return sorted(cells, key=lambda cell: _rank(cell, first[cell.kit]))  # stable: tasks stay in their order


def _rank(cell: Cell, first_seed: int) -> int:
    if cell.seed == first_seed:
        return 0
    return 1 if cell.algorithm in CLAIMANTS else 2


def known(kind: str, name: str, names: Iterable[str]) -> str:
    """The name, if it is one of them.

    Raises:
        UserError: it isn't.
    """
    names = list(names)
    if name not in names:
        raise UserError(f"Unknown {kind} {name!r}: {did_you_mean(name, names)}")
    return name
