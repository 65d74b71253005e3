"""`envtf plan` and `envtf bench planning`: planners that act through a world model."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from envtf_lit.cli.output import console, hush_lightning
from envtf_lit.cli.signatures import CORES, File, Folder, Natural, Positive, run_command
from envtf_lit.errors import UserError
from envtf_lit.options.schema import Precision

if TYPE_CHECKING:
    from envtf_lit.evaluation.planning import PlannedReturns
    from envtf_lit.robots.tasks import Robot

Options = Annotated[tuple[str, ...], "NAME=VALUE"]


def plan(
    *,
    world_model: Folder,
    task: Annotated[str, "TASK"],
    planner: Literal["random", "cem", "icem", "mppi", "gradient"] = "mppi",
    policy: Folder | None = None,
    no_critics: bool = False,
    option: Options = (),
    episodes: Positive = 1,
    steps: Positive | None = None,
    seed: Natural = 0,
    threads: Positive = CORES,
    precision: Precision = "fp32",
    out: File | None = None,
    video: File | None = None,
    dataset: File | None = None,
    quiet: bool = False,
) -> None:
    """Plays a planner in MuJoCo.

    Args:
        world_model: that it plans through.
        task: whose robot acts, such as hopper-medium.
        planner: family.
        policy: whose plan the search begins at, and whose critics, where its folder has some, judge what follows a
            plan, with their own discount; it is played beside the planner.
        no_critics: nothing follows a plan, whatever the policy's folder has.
        option: of the planner, such as horizon=20; may be repeated.
        episodes: of each.
        steps: of an episode at most; default: the robot's 1000.
        seed: of everything random.
        threads: CPU threads.
        precision: of matrix products while it plans.
        out: JSON.
        video: GIF of the median episode, beside what the model imagines of the same actions; needs --dataset.
        dataset: that the model was trained on, in whose units the video tells the error.
        quiet: no progress bar.

    Raises:
        UserError: a video without a dataset.
    """
    if video is not None and dataset is None:
        raise UserError("--video tells the model's error in units of its data: name them with --dataset FILE.")
    import torch

    from envtf_lit.evaluation.planning import score_planner
    from envtf_lit.files import write_json
    from envtf_lit.results import claim
    from envtf_lit.robots.tasks import get_task

    if out is not None:
        claim(out, "decisions_per_second")
    torch.set_num_threads(threads)
    robot = get_task(task).robot
    played: dict[str, Any] = dict(
        policy=policy,
        critics=not no_critics,
        episodes=episodes,
        steps=steps,
        seed=seed,
        precision=precision,
        progress=not quiet,
    )
    found = score_planner(world_model, robot, planner, option, **played)
    _print_scores(found, planner, policy)
    if out is not None:
        asked = dict(task=task, planner=planner, options=list(option), seed=seed, threads=threads, precision=precision)
        write_json(out, asked | _rates(found))
    if video is not None and dataset is not None:
        _draw(found, world_model, robot, dataset, video)


def _rates(found: "PlannedReturns") -> dict[str, object]:
    prior = {} if found.prior is None else {"prior_returns": found.prior.returns.tolist()}
    rates = {"returns": found.planned.returns.tolist(), "decisions_per_second": found.decisions_per_second}
    return rates | {"discount": found.discount, "critics": found.valued} | prior


def _print_scores(found: "PlannedReturns", planner: str, policy: Path | None) -> None:
    from rich.table import Table

    table = Table("", "return", "score", "steps", "decisions/s", box=None)
    rate = f"{found.decisions_per_second:.1f}"
    for name, played, speed in ((planner, found.planned, rate), (policy.name if policy else "", found.prior, "")):
        if played is not None:
            row = played.returns.mean(), played.scores.mean(), played.lengths.mean()
            table.add_row(name, f"{row[0]:.1f}", f"{row[1]:.1f}", f"{row[2]:.0f}", speed)
    console().print(table, soft_wrap=False)
    after = f"{policy}'s critics judge what follows a plan" if found.valued else "Nothing follows a plan"
    console().print(f"{after}; discount {found.discount:g}.")


def _draw(found: "PlannedReturns", world_model: Path, robot: "Robot", dataset: Path, video: Path) -> None:
    from envtf_lit.data.sources.files import load_dataset
    from envtf_lit.figures.video import real_vs_imagined
    from envtf_lit.world_models.forecast import Scale
    from envtf_lit.world_models.store import load_world_model

    scale = Scale.of(load_dataset(dataset))
    real_vs_imagined(load_world_model(world_model), found.planned.median, robot, scale, video)


def bench_planning(
    *,
    out: File | None = None,
    work: Folder = Path(".envtf/planning"),
    transitions: Positive = 20_000,
    updates: Positive = 6_000,
    episodes: Positive = 10,
    seed: Natural = 0,
    threads: Positive = CORES,
    quiet: bool = False,
) -> None:
    """Compares planners through a learned pendulum and through the true one.

    Args:
        out: JSON; the picture of a plan lies beside it.
        work: where data and model lie.
        transitions: random steps that the model is learned from.
        updates: of its training.
        episodes: that each planner plays.
        seed: of everything random.
        threads: CPU threads.
        quiet: no progress bar.
    """
    from envtf_lit.studies.planning import PlanningOptions, planning_table, run_planning

    options = PlanningOptions(transitions, updates, episodes, seed=seed, threads=threads)
    result = run_planning(out, work=work, options=options, progress=not quiet)
    console().print(planning_table(result))


FUNCTIONS = {"plan": plan, "bench planning": bench_planning}


def run(name: str, words: Sequence[str]) -> None:
    """Runs `envtf plan` or `envtf bench planning`."""
    hush_lightning()
    run_command(FUNCTIONS[name], name, words)
