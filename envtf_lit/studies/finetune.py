"""The fine-tuning study: updates that a world model needs on a new robot, from scratch and from another robot's model.

A world model is trained on `hopper-medium-replay`. Then rows of Hopper with hidden friction, mass and strength are
learned three times: from scratch, from scratch with as few updates as the fine-tuned run has, and from that model. Each
run's cosine schedule is as long as it is. All runs go through `envtf model fit`, as a user's would.
"""

import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from envtf_lit.data.sources.files import save_dataset
from envtf_lit.devices import pick_device, resolved
from envtf_lit.files import write_json
from envtf_lit.results import claim
from envtf_lit.robots.tasks import get_task
from envtf_lit.studies.machine import facts
from envtf_lit.training import LIGHTNING
from envtf_lit.zoo.collect import collect

BASE, TARGET = "hopper-medium-replay", "hopper-medium-replay-hidden"
ERROR = "val/open_loop_error"  # held out: geometric mean of the open-loop nmse over 20 steps
WORK = Path(".envtf/finetune")  # where data and models are kept unless told otherwise

Curve = dict[int, float]  # held-out errors by updates


@dataclass(frozen=True)
class FinetuneOptions:
    """The budgets of the runs.

    Attributes:
        base_updates: gradient steps of the model that fine-tuning starts from.
        updates: from scratch on the new robot.
        tuned_updates: of the fine-tuned run; None: a quarter of those.
        every: updates between two looks at the held-out error.
        rows: of the new robot.
        base_rows: of the robot that fine-tuning starts from.
        learning_rate: of the fine-tuned run; from scratch it is 0.001.
        freeze: as `envtf model fit --model.freeze` takes it.
        seed: of data and training.
        threads: processes that collect data.
    """

    base_updates: int = 4_000
    updates: int = 2_000
    tuned_updates: int | None = None
    every: int = 25
    rows: int = 20_000
    base_rows: int = 100_000
    learning_rate: float = 0.001
    freeze: str = "[]"
    seed: int = 0
    threads: int = 1


def run_finetune(out: Path | None = None, *, work: Path = WORK, options: FinetuneOptions) -> dict[str, Any]:
    """Trains the four runs, unless they lie in the work folder, and compares their held-out errors.

    Args:
        out: JSON file of the result; None writes none.
        work: folder of data and models; what lies there from an earlier call is used again.
        options: the budgets.

    Returns:
        `compare_curves`, the options, and the machine.

    Raises:
        UserError: `out` is there and no such result.
        CalledProcessError: `envtf model fit` failed, and has said why.
    """
    if out is not None:
        claim(out, "short_scratch_error")
    work = work / f"seed-{options.seed}"
    base_data, data = _dataset(BASE, options.base_rows, work, options), _dataset(TARGET, options.rows, work, options)
    base = work / f"base-{options.base_updates}"
    _fit(base, base_data, options.base_updates, options.base_updates // 4, options.seed)
    scratch = _fit(work / f"scratch-{options.updates}", data, options.updates, options.every, options.seed)
    updates = options.tuned_updates or options.updates // 4
    short = _fit(work / f"scratch-{updates}", data, updates, options.every, options.seed)
    parts = "-".join(options.freeze.strip("[]").replace(" ", "").split(","))
    flags = {
        "model.init_from": base / "published",
        "model.freeze": options.freeze,
        "model.options.learning_rate": options.learning_rate,
    }
    run = work / f"tuned-{updates}-{options.learning_rate:g}-{parts}"
    tuned = _fit(run, data, updates, options.every, options.seed, flags)
    result = compare_curves(scratch, short, tuned) | asdict(options) | facts(pick_device(), "auto")
    if out is not None:
        write_json(out, result)
    return result


def compare_curves(scratch: Curve, short: Curve, tuned: Curve) -> dict[str, Any]:
    """Best held-out errors, and the updates after which the fine-tuned model is as good as one from scratch ever gets.

    Args:
        scratch: of the run from scratch.
        short: from scratch with the fine-tuned run's updates and schedule.
        tuned: of the fine-tuned run.
    """
    fewest = min(scratch, key=scratch.__getitem__)
    target = scratch[fewest]
    reached = next((updates for updates, error in tuned.items() if error <= target), None)
    return {
        "scratch_error": target,
        "scratch_updates": fewest,
        "tuned_updates_to_scratch_error": reached,
        "share_of_updates": None if reached is None else reached / fewest,
        "tuned_error": min(tuned.values()),
        "short_scratch_error": min(short.values()),
        "scratch_curve": scratch,
        "tuned_curve": tuned,
    }


def _dataset(task: str, rows: int, work: Path, options: FinetuneOptions) -> Path:
    path = work / f"{task}-{rows}.h5"
    if not path.exists():
        save_dataset(collect(get_task(task), rows, seed=options.seed, workers=options.threads), path)
    return path


def _fit(run: Path, data: Path, updates: int, every: int, seed: int, further: dict[str, Any] | None = None) -> Curve:
    """The held-out errors by updates of a model trained into `run`, with a look every so many updates."""
    if not (run / "published").exists():
        shutil.rmtree(run, ignore_errors=True)  # of a call that was interrupted
        flags = {
            "data.path": data,
            "model.options.updates": updates,
            "model.options.updates_per_epoch": every,
            "model.seed": seed,
            "seed_everything": seed,
            "trainer.precision": LIGHTNING[resolved("auto")],
            "trainer.logger": "CSVLogger",
            "trainer.logger.save_dir": run,
            "trainer.logger.name": "log",
            "trainer.logger.version": 0,
            "trainer.enable_progress_bar": "false",
            "trainer.enable_model_summary": "false",
        } | (further or {})
        command = [sys.executable, "-m", "envtf_lit", "model", "fit"]
        subprocess.run([*command, *(f"--{name}={value}" for name, value in flags.items())], check=True)
        (run / "log/version_0/published").rename(run / "published")
    rows = pd.read_csv(run / "log/version_0/metrics.csv").dropna(subset=[ERROR])
    return {int(step) + 1: float(error) for step, error in zip(rows["step"], rows[ERROR], strict=True)}
