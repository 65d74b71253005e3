"""`envtf hidden`: what memory is worth where a robot's friction, mass and strength are hidden."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.evaluation.in_context import Recognition, recognition, recognition_metrics, stretches
from envtf_lit.figures.in_context import recognition_curves
from envtf_lit.files import write_json
from envtf_lit.results import claim
from envtf_lit.robots.tasks import Task, get_task
from envtf_lit.studies.suite import WORK, Suite, SuiteOptions, build_suite, flat_settings, heading, kept, measurable
from envtf_lit.training import pick_device
from envtf_lit.world_models.forecast import Scale
from envtf_lit.zoo.collect import collect
from envtf_lit.zoo.snapshots import plan

UNSEEN_SEED = 1_000_000  # added to the suite's seed: no draw of its data comes again


@dataclass(frozen=True)
class HiddenOptions:
    """What models are measured on.

    Attributes:
        unseen: transitions collected for it.
        stretches: of those, drawn at random.
    """

    unseen: int = 100_000
    stretches: int = 2_000


def compare(
    out: Path,
    *,
    robots: Sequence[str] = ("halfcheetah", "walker2d"),
    tier: str = "medium-replay",
    work: Path = WORK,
    options: SuiteOptions,
    measured: HiddenOptions = HiddenOptions(),
    progress: bool = True,
    report: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Trains the suite's models on robots with hidden dynamics, and measures them on draws that none has seen.

    Args:
        out: JSON file to write after each robot; the figure lies beside it as PNG, its numbers as CSV.
        robots: names.
        tier: of the data that models are trained and measured on.
        work: folder of suites; what was trained there before with the same options is used again.
        options: of the data and the models.
        measured: on how much.
        progress: shows bars.
        report: called with a line for each robot and model.

    Returns:
        What the file holds: options, and `robot.model.metric` as `recognition_metrics` explains.

    Raises:
        UserError: an unknown robot or tier, an option out of range, a folder that cannot be written, or a file in the
            way that is none of this command's.
    """
    tasks = [get_task(f"{robot}-{tier}-hidden") for robot in dict.fromkeys(robots)]
    for task in tasks:
        plan(task, measured.unseen)  # complains before anything is trained
    claim(out, "measured.unseen", [out.with_suffix(".png"), out.with_suffix(".csv")])
    torch.set_num_threads(options.threads)
    metrics = heading(tier, options, measured=measured)
    found = dict[str, dict[str, Recognition]]()
    for task in tasks:
        robot, suite = task.robot.name, build_suite(task.name, work, options, progress=progress)
        found[robot] = _measure(task, suite, work / task.name, measured, progress)
        metrics |= suite.costs
        for name, value in recognition_metrics(found[robot]).items():
            metrics[f"{robot}.{name}"] = value
            if isinstance(value, float):
                report(f"{robot}.{name}: {value:.3g}")
        write_json(out, metrics)
        recognition_curves(found, out.with_suffix(".png"))
    return metrics


def _unseen(task: Task, suite: Suite, transitions: int, progress: bool) -> Path:
    """A file of episodes of new draws, named by what made them."""
    seed = suite.options.seed + UNSEEN_SEED
    path = suite.dataset.with_name(f"unseen-{transitions}-{seed}.h5")
    if not path.exists():
        save_dataset(collect(task, transitions, seed=seed, workers=suite.options.threads, progress=progress), path)
    return path


def _measure(task: Task, suite: Suite, home: Path, measured: HiddenOptions, progress: bool) -> dict[str, Recognition]:
    """Every model's errors, now or when they were measured on the same draws."""
    unseen, device = _unseen(task, suite, measured.unseen, progress), pick_device()
    settings = flat_settings(task.tier, suite.options, measured=measured)
    scale = Scale.of(suite.split()[0], device)
    trajectories = stretches(load_dataset(unseen), measured.stretches, seed=suite.options.seed).to(device)

    def one(folder: Path) -> dict[str, Any]:
        return asdict(recognition(measurable(folder, suite.options), trajectories, scale))

    return {
        name: Recognition(
            **kept(home, f"hidden-{name}", settings, [suite.dataset, unseen, folder], partial(one, folder))
        )
        for name, folder in suite.folders.items()
    }
