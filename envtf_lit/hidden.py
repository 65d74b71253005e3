"""`envtf hidden`: what memory is worth where a robot's friction, mass and strength are hidden."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from envtf_lit.data.behaviour import collect, plan
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.formats import load_dataset, save_dataset
from envtf_lit.evaluation.recognition import Recognition, recognition, recognition_metrics, stretches
from envtf_lit.figures.recognition import recognition_curves
from envtf_lit.storage import write_json
from envtf_lit.suite import WORK, Suite, SuiteOptions, build_suite
from envtf_lit.tasks import Task, get_task
from envtf_lit.world_models.horizon import Scale
from envtf_lit.world_models.store import load_world_model

UNSEEN_SEED = 1_000_000  # added to the suite's seed: no draw of its data comes again
STRETCHES = 2_000


def compare(
    out: Path,
    *,
    robots: Sequence[str] = ("halfcheetah", "walker2d"),
    tier: str = "medium-replay",
    work: Path = WORK,
    options: SuiteOptions,
    unseen: int = 100_000,
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
        unseen: transitions to collect for the measurement.
        progress: shows bars.
        report: called with a line for each robot and model.

    Returns:
        What the file holds: options, and `robot.model.metric` as `recognition_metrics` explains.

    Raises:
        UserError: an unknown robot or tier, an option out of range, or a folder that cannot be written.
    """
    tasks = {robot: get_task(f"{robot}-{tier}-hidden") for robot in robots}
    for task in tasks.values():
        plan(task, unseen)  # complains before anything is trained
    metrics: dict[str, Any] = {"tier": tier, "transitions": options.transitions, "updates": options.updates}
    metrics |= {"context": options.context, "unseen_transitions": unseen, "stretches": STRETCHES, "seed": options.seed}
    found = dict[str, dict[str, Recognition]]()
    for robot, task in tasks.items():
        suite = build_suite(task.name, work, options, progress=progress)
        found[robot] = _measure(suite, _unseen(task, suite, unseen, progress))
        for name, seconds in suite.seconds.items():
            metrics[f"{robot}.{name}.train_seconds"] = seconds
        for name, value in recognition_metrics(found[robot]).items():
            metrics[f"{robot}.{name}"] = value
            if isinstance(value, float):
                report(f"{robot}.{name}: {value:.3g}")
        write_json(out, metrics)
        recognition_curves(found, out.with_suffix(".png"))
    return metrics


def _unseen(task: Task, suite: Suite, transitions: int, progress: bool) -> OfflineDataset:
    """Episodes of new draws; their file is named by what made them."""
    seed = suite.options.seed + UNSEEN_SEED
    path = suite.dataset.with_name(f"unseen-{transitions}-{seed}.h5")
    if not path.exists():
        save_dataset(collect(task, transitions, seed=seed, workers=suite.options.threads, progress=progress), path)
    return load_dataset(path)


def _measure(suite: Suite, unseen: OfflineDataset) -> dict[str, Recognition]:
    scale = Scale.of(suite.split()[0])
    trajectories = stretches(unseen, STRETCHES, seed=suite.options.seed)
    return {name: recognition(load_world_model(folder), trajectories, scale) for name, folder in suite.folders.items()}
