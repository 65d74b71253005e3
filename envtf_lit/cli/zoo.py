"""`envtf zoo`: datasets of four robots, and the behaviour policies that they come from."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from envtf_lit.cli.output import console
from envtf_lit.cli.signatures import CORES, Folder, Natural, Robot, run_command
from envtf_lit.errors import UserError

Task = Annotated[str, "TASK"]
Number = Annotated[int, "N"]


def show(*, zoo: Folder | None = None) -> None:
    """Prints the twenty datasets.

    Args:
        zoo: policies of your own, from `envtf zoo train`.
    """
    from rich.table import Table

    from envtf_lit.zoo.build import catalogue

    table = Table("dataset", "policies", "score of their deterministic actions", box=None)
    for line in catalogue(zoo):
        table.add_row(*line)
    console().print(table, soft_wrap=False)


def build(
    *tasks: Task,
    all: bool = False,
    out: Folder = Path("data/zoo"),
    transitions: Number | None = None,
    full: bool = False,
    workers: Natural = CORES,
    seed: Natural = 0,
    quiet: bool = False,
    zoo: Folder | None = None,
) -> None:
    """Collects datasets into a folder.

    Args:
        tasks: such as hopper-medium, hopper-medium-v4, ant-medium-105d, hopper-medium-hidden.
        all: the twenty, beside those named.
        out: where they go.
        transitions: rows of each; default: 200,000.
        full: 1,000,000 rows of each.
        workers: processes, which do not change the data.
        seed: of everything random.
        quiet: no progress bars.
        zoo: policies of your own, from `envtf zoo train`.

    Raises:
        UserError: two sizes.
    """
    if full and transitions is not None:
        raise UserError(f"--full and --transitions {transitions} ask for two sizes: give one of them.")
    from envtf_lit.figures.zoo import score_distributions
    from envtf_lit.robots.tasks import TASKS
    from envtf_lit.zoo import build as collecting

    report = console().print
    collecting.build(
        [*(TASKS if all else ()), *tasks],
        out,
        transitions=collecting.FULL if full else collecting.TRANSITIONS if transitions is None else transitions,
        seed=seed,
        workers=workers,
        zoo=zoo,
        progress=not quiet,
        draw=score_distributions,
        report=report,
    )
    report(f"Table and figure: {out}/index.md")


def train(
    *,
    robot: Robot,
    out: Folder,
    algorithm: Literal["crossq", "sac"] = "crossq",
    steps: Number = 600_000,
    seed: Natural = 0,
    quiet: bool = False,
) -> None:
    """Trains behaviour policies.

    Args:
        robot: whose.
        out: for build's and list's --zoo.
        algorithm: what trains them.
        steps: environment steps.
        seed: of everything random.
        quiet: no progress bars.
    """
    from envtf_lit.robots.tasks import ROBOTS
    from envtf_lit.zoo import train as training

    folder = training.train(ROBOTS[robot], out, algorithm=algorithm, steps=steps, seed=seed, progress=not quiet)
    console().print(f"Wrote {folder}. Next: envtf zoo build --zoo {out} TASK")


def settle(*, robot: Robot, out: Folder, last: Natural = 3, noise: float = 0.5) -> None:
    """Exchanges a series' last snapshot for the late ones' mean.

    Args:
        robot: whose.
        out: as given to train.
        last: snapshots to average.
        noise: factor of the standard deviations.
    """
    from envtf_lit.robots.tasks import ROBOTS
    from envtf_lit.zoo import train as training

    kept = training.average_last_snapshots(ROBOTS[robot], out, last=last, noise=noise)
    score = ROBOTS[robot].normalised_score(kept.mean_return)
    console().print(f"The last snapshot now returns {kept.mean_return:.0f} (score {score:.1f}).")


FUNCTIONS = {"zoo list": show, "zoo build": build, "zoo train": train, "zoo settle": settle}


def run(name: str, words: Sequence[str]) -> None:
    """Runs `envtf zoo list`, `build`, `train` or `settle`."""
    run_command(FUNCTIONS[name], name, words)
