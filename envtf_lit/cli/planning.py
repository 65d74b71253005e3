"""`envtf plan` and `envtf bench planning`: planners that act through a world model."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
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


@dataclass(frozen=True)
class Episodes:
    """The episodes that a planner plays, and beside it the policy that it begins at.

    Attributes:
        episodes: of each.
        steps: of an episode at most; default: as many as the robot's have, or the log's longest.
        seed: of everything random.
        precision: of matrix products while it plans.
    """

    episodes: Positive = 1
    steps: Positive | None = None
    seed: Natural = 0
    precision: Precision = "fp32"


def plan(
    *,
    world_model: Folder,
    task: Annotated[str, "TASK"] | None = None,
    dataset: File | None = None,
    planner: Literal["random", "cem", "icem", "mppi", "gradient"] = "mppi",
    policy: Folder | None = None,
    no_critics: bool = False,
    option: Options = (),
    played: Episodes = Episodes(),
    threads: Positive = CORES,
    out: File | None = None,
    video: File | None = None,
    quiet: bool = False,
) -> None:
    """Plays a planner, in a simulator or in the world model itself.

    Args:
        world_model: that it plans through.
        task: whose simulator it plays in, such as hopper-medium, or a Gymnasium id such as Pendulum-v1. Without one it
            plays in the world model, from where the episodes of --dataset begin, and returns are the model's opinion.
        dataset: that the model was trained on; in its units a video tells the error.
        planner: family.
        policy: whose plan the search begins at, and whose critics, where its folder has some, judge what follows a
            plan, with their own discount; it is played beside the planner.
        no_critics: nothing follows a plan, whatever the policy's folder has.
        option: of the planner, such as horizon=20; may be repeated.
        played: by each.
        threads: CPU threads.
        out: JSON.
        video: GIF of the median episode in MuJoCo, beside what the model imagines of the same actions; needs --dataset.
        quiet: no progress bar.

    Raises:
        UserError: neither task nor dataset, or a video without both.
    """
    _check_places(task, dataset, video)
    import torch

    from envtf_lit.devices import resolved
    from envtf_lit.evaluation.planning import robot_to_plan_for, score_planner
    from envtf_lit.files import write_json
    from envtf_lit.results import claim
    from envtf_lit.robots.tasks import ROBOTS

    if out is not None:
        claim(out, "decisions_per_second")
    torch.set_num_threads(threads)
    robot = robot_to_plan_for(world_model, task, dataset, steps=played.steps)
    if video is not None and robot.name not in ROBOTS:
        raise UserError(f"--video draws the robots of the tasks, and {robot.name} is none of them: leave it out.")
    wishes: dict[str, Any] = dict(policy=policy, critics=not no_critics, progress=not quiet)
    found = score_planner(world_model, robot, planner, option, **asdict(played), **wishes)
    _print_scores(found, planner, policy, imagined=task is None)
    if out is not None:
        asked = dict(task=task, planner=planner, options=list(option), seed=played.seed, threads=threads)
        write_json(out, asked | dict(precision=resolved(played.precision, torch.device("cpu"))) | _rates(found))
    if video is not None and dataset is not None:
        _draw(found, world_model, robot, dataset, video)


def _check_places(task: str | None, dataset: Path | None, video: Path | None) -> None:
    """Something to play in, and to draw, is named."""
    if task is None and dataset is None:
        raise UserError(
            "A planner plays in a simulator or in the world model: name a --task, such as hopper-medium, or, of a "
            "robot of your own, the log that its model was trained on: --dataset FILE."
        )
    if video is not None and dataset is None:
        raise UserError("--video tells the model's error in units of its data: name them with --dataset FILE.")
    if video is not None and task is None:
        raise UserError("--video shows MuJoCo beside the model: name a --task whose robot it draws.")


def _rates(found: "PlannedReturns") -> dict[str, object]:
    prior = {} if found.prior is None else {"prior_returns": found.prior.returns.tolist()}
    rates = {"returns": found.planned.returns.tolist(), "decisions_per_second": found.decisions_per_second}
    return rates | {"discount": found.discount, "critics": found.valued} | prior


def _print_scores(found: "PlannedReturns", planner: str, policy: Path | None, *, imagined: bool) -> None:
    from rich.table import Table

    table = Table("", "imagined return" if imagined else "return", "score", "steps", "decisions/s", box=None)
    rate = f"{found.decisions_per_second:.1f}"
    for name, played, speed in ((planner, found.planned, rate), (policy.name if policy else "", found.prior, "")):
        if played is not None:
            score = played.scores.mean()
            known = f"{score:.1f}" if score == score else "–"  # NaN of a robot without references
            table.add_row(name, f"{played.returns.mean():.1f}", known, f"{played.lengths.mean():.0f}", speed)
    console().print(table, soft_wrap=False)
    after = f"{policy}'s critics judge what follows a plan" if found.valued else "Nothing follows a plan"
    console().print(f"{after}; discount {found.discount:g}.")
    if imagined:
        console().print(
            "Imagined returns are the world model's opinion, which nobody measured; an episode ends early where the "
            "robot falls, or where the model no longer knows."
        )


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
