"""`envtf compare`: every algorithm on every task, and the report on it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from jsonargparse.typing import NonNegativeInt

from envtf_lit.cli.output import console, hush_lightning
from envtf_lit.cli.signatures import CORES, File, Folder, Natural, Positive, Robot, run_command
from envtf_lit.errors import UserError

# written out: to import what knows them takes seconds
Tier = Literal["random", "medium", "medium-replay", "medium-expert", "full-replay"]
Algorithm = Literal[
    "bc", "wbc", "td3_bc", "rebrac", "iql", "sac", "cql", "mopo", "combo", "rambo", "mobile", "et_cql_paper", "et_cql"
]
Kit = Literal["published", "same"]
Seeds = Annotated[tuple[int, ...], NonNegativeInt, "N"]
RESULTS = Path("benchmarks/comparison/results.csv")


def compare_run(
    *,
    budget: Literal["cpu-small", "cpu", "gpu", "paper"] = "cpu-small",
    kits: tuple[Kit, ...] = ("published", "same"),
    robots: tuple[Robot, ...] = ("hopper", "halfcheetah", "walker2d", "ant"),
    tiers: tuple[Tier, ...] = ("random", "medium", "medium-replay", "medium-expert", "full-replay"),
    algorithms: tuple[Algorithm, ...] | None = None,
    seeds: Seeds | None = None,
    workers: Positive = CORES,
    ray_address: Annotated[str, "ADDRESS"] | None = None,
    out: File = RESULTS,
    work: Folder = Path(".envtf/comparison"),
    data_share: Annotated[float, "SHARE"] | None = None,
    data_seed: Natural | None = None,
    transitions: Positive | None = None,
    updates: Positive | None = None,
    model_updates: Positive | None = None,
    episodes: Positive | None = None,
    quiet: bool = False,
) -> None:
    """Does what is missing of the grid.

    Args:
        budget: of each run; see docs/comparison.md.
        kits: whose settings, those published for each task or the same for all.
        robots: which of the four.
        tiers: which of the five.
        algorithms: which; default: the kit's.
        seeds: of the training; default: 0 as published, 0 1 2 with the same kit.
        workers: processes at a time, each with one thread.
        ray_address: of a Ray cluster to do it on, such as auto; local starts one of --workers cores.
        out: CSV of finished runs; curves.csv and shared.csv lie beside it.
        work: where datasets, world models and policies lie.
        data_share: of the budget's transitions, such as 0.1.
        data_seed: of datasets and world models.
        transitions: of each dataset, in the budget's place.
        updates: of each policy, likewise.
        model_updates: of each world model, likewise.
        episodes: of the evaluation at the end, likewise; along the way 5 at most.
        quiet: no progress bar.

    Raises:
        UserError: two sizes of the data.
    """
    if data_share is not None and transitions is not None:
        raise UserError(
            f"--data-share {data_share:g} and --transitions {transitions} ask for two sizes: give one of them."
        )
    from envtf_lit.comparison.budgets import budget_of
    from envtf_lit.comparison.grid import grid
    from envtf_lit.comparison.runner import run_grid

    changes = dict(updates=updates, episodes=episodes, transitions=transitions, model_updates=model_updates)
    spent = budget_of(budget, **changes, data_share=data_share, data_seed=data_seed)
    cells = grid(spent, robots=robots, tiers=tiers, algorithms=algorithms, kits=kits, seeds=seeds)
    report, progress = console().print, not quiet
    run_grid(cells, out, work=work, workers=workers, ray_address=ray_address, progress=progress, report=report)
    report(f"Next: envtf compare report --results {out} --budget '{spent}'")


def compare_report(
    *, results: File = RESULTS, out: Folder = Path("reports/comparison"), budget: str | None = None
) -> None:
    """Writes tables and figures.

    Args:
        results: CSV of finished runs.
        out: where they go.
        budget: such as cpu-small, or all that --budget and what differs from it say; default: that of most runs.
    """
    from envtf_lit.comparison.report import report

    found = report(results, out, budget=budget)
    console().print(f"{found['comparison.runs']} runs of {found['comparison.budget']}: {out}/index.md")


FUNCTIONS = {"compare run": compare_run, "compare report": compare_report}


def run(name: str, words: Sequence[str]) -> None:
    """Runs `envtf compare run` or `report`."""
    hush_lightning()
    run_command(FUNCTIONS[name], name, words)
