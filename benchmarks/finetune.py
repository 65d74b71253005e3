"""What a model learned of one robot is worth on another: `python benchmarks/finetune.py [--out OUT.json]`.

A world model is trained on `hopper-medium-replay`. Then 20,000 rows of Hopper with hidden friction, mass and strength
are learned twice: from scratch, and from that model with a quarter of the updates (each run's cosine schedule is as
long as it is). Printed are the best held-out errors (`val/open_loop_error`, geometric mean of the open-loop nmse over
20 steps) and the updates after which the fine-tuned model is as good as the one from scratch ever gets. All runs go
through `envtf model fit`, as a user's would; what lies in the work folder from an earlier call is used again.
"""

import argparse
import json
import os
import shutil
import sys
from pathlib import Path

import pandas as pd

from envtf_lit.cli.main import main as envtf
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.robots.tasks import get_task
from envtf_lit.studies.machine import facts
from envtf_lit.training import pick_device
from envtf_lit.zoo.collect import collect

BASE, TARGET = "hopper-medium-replay", "hopper-medium-replay-hidden"
ERROR = "val/open_loop_error"


def dataset(task: str, rows: int, work: Path, options: argparse.Namespace) -> Path:
    path = work / f"{task}-{rows}.h5"
    if not path.exists():
        save_dataset(collect(get_task(task), rows, seed=options.seed, workers=options.threads), path)
    return path


def fit(run: Path, path: Path, updates: int, every: int, options: argparse.Namespace, *flags: str) -> pd.Series:
    """Trains one model into `run`, with a look at the held-out error every so many updates; that error by updates."""
    if not (run / "published").exists():
        shutil.rmtree(run, ignore_errors=True)  # of a call that was interrupted
        flags_of_all = {
            "data.path": path,
            "model.options.updates": updates,
            "model.options.updates_per_epoch": every,
            "model.seed": options.seed,
            "seed_everything": options.seed,
            "trainer.precision": "bf16-mixed",
            "trainer.logger": "CSVLogger",
            "trainer.logger.save_dir": run,
            "trainer.logger.name": "log",
            "trainer.logger.version": 0,
            "trainer.enable_progress_bar": "false",
            "trainer.enable_model_summary": "false",
        }
        envtf(["model", "fit", *(f"--{name}={value}" for name, value in flags_of_all.items()), *flags])
        (run / "log/version_0/published").rename(run / "published")
    rows = pd.read_csv(run / "log/version_0/metrics.csv").dropna(subset=[ERROR])
    return rows.set_index(rows["step"] + 1)[ERROR]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, metavar="FILE", help="JSON")
    parser.add_argument("--work", type=Path, default=Path(".envtf/finetune"), metavar="DIR")
    parser.add_argument("--base-updates", type=int, default=4_000)
    parser.add_argument("--updates", type=int, default=2_000, help="from scratch on the new robot")
    parser.add_argument("--tuned-updates", type=int, help="of the fine-tuned run; default: a quarter of them")
    parser.add_argument("--every", type=int, default=25, help="updates between two looks at the held-out error")
    parser.add_argument("--rows", type=int, default=20_000, help="of the new robot")
    parser.add_argument("--base-rows", type=int, default=100_000)
    parser.add_argument("--learning-rate", type=float, default=0.001, help="of the fine-tuned run; from scratch: 0.001")
    parser.add_argument("--freeze", default="[]", help="as --model.freeze")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    work = options.work / f"seed-{options.seed}"

    base_data, data = dataset(BASE, options.base_rows, work, options), dataset(TARGET, options.rows, work, options)
    fit(work / f"base-{options.base_updates}", base_data, options.base_updates, options.base_updates // 4, options)
    base = work / f"base-{options.base_updates}" / "published"
    scratch = fit(work / f"scratch-{options.updates}", data, options.updates, options.every, options)
    updates = options.tuned_updates or options.updates // 4
    short = fit(work / f"scratch-{updates}", data, updates, options.every, options)
    flags = {"init_from": base, "freeze": options.freeze, "options.learning_rate": options.learning_rate}
    parts = "-".join(options.freeze.strip("[]").replace(" ", "").split(","))
    run = work / f"tuned-{updates}-{options.learning_rate:g}-{parts}"
    tuned = fit(
        run, data, updates, options.every, options, *(f"--model.{name}={value}" for name, value in flags.items())
    )

    target = float(scratch.min())
    reached = tuned.index[tuned <= target]
    result = {
        "scratch_error": target,
        "scratch_updates": int(scratch.idxmin()),
        "tuned_updates_to_scratch_error": int(reached[0]) if len(reached) else None,
        "share_of_updates": float(reached[0] / scratch.idxmin()) if len(reached) else None,
        "tuned_error": float(tuned.min()),
        "short_scratch_error": float(short.min()),  # with the fine-tuned run's updates and schedule, without its start
        "scratch_curve": {int(update): float(error) for update, error in scratch.items()},
        "tuned_curve": {int(update): float(error) for update, error in tuned.items()},
        **{name: value for name, value in vars(options).items() if name not in ("out", "work")},
        **facts(pick_device(), "bf16"),
    }
    text = json.dumps(result, indent=2) + "\n"
    sys.stdout.write(text)
    if options.out:
        options.out.write_text(text)


if __name__ == "__main__":
    main()
