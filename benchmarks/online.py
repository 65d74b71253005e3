"""What learning online adds to a policy of a log, on Hopper: `python benchmarks/online.py [--out OUT.json]`.

Conservative Q-learning learns from `hopper-medium-replay`, which has seed 0; its policy then learns on online, once for
each seed, by `envtf agent fit` as a user's would. Scores are of the same 20 episodes before and after. What lies in the
work folder is used again.
"""

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pandas as pd

from envtf_lit.data.sources.files import save_dataset
from envtf_lit.files import write_json
from envtf_lit.robots.tasks import get_task
from envtf_lit.studies.machine import facts
from envtf_lit.training import pick_device
from envtf_lit.zoo.collect import collect

TASK, EPISODES = "hopper-medium-replay", 20
QUIET = ["--trainer.logger=false", "--trainer.enable_progress_bar=false", "--trainer.enable_model_summary=false"]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, metavar="FILE", help="JSON")
    parser.add_argument("--work", type=Path, default=Path(".envtf/online"), metavar="DIR")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--rows", type=int, default=100_000, help="of the log")
    parser.add_argument("--offline-updates", type=int, default=4_500)
    parser.add_argument("--env-steps", type=int, default=20_000, help="of each run, an update for each")
    parser.add_argument("--every", type=int, default=2_500, help="updates between two looks at the policy")
    given = parser.parse_args()
    result = vars(given) | {"runs": measure(given)} | facts(pick_device(), "fp32")
    result = {name: value for name, value in result.items() if name not in ("out", "work")}
    if given.out is not None:
        write_json(given.out, result)
    sys.stdout.write(json.dumps(result, indent=2) + "\n")


def measure(given: argparse.Namespace) -> dict[int, dict[str, Any]]:
    """By seed: the scores before the first step and after the last one, and the whole curve."""
    log = given.work / f"{TASK}-{given.rows}.h5"
    if not log.exists():
        save_dataset(collect(get_task(TASK), given.rows, seed=0, workers=1).with_split(0.1, 0), log)
    start = given.work / f"cql-{given.offline_updates}"
    flags = [f"--model.options.{name}={given.offline_updates}" for name in ("updates", "updates_per_epoch")]
    fit(start, log, "--model.algorithm=cql", *flags)
    found = dict[int, dict[str, Any]]()
    for seed in given.seeds:
        run = given.work / f"sac-{given.env_steps}-{seed}"
        curves = fit(
            run,
            log,
            "--config=online",
            f"--model.init_from={start / 'published'}",
            f"--model.seed={seed}",
            f"--seed_everything={seed}",
            f"--model.options.updates={5_000 + given.env_steps}",  # the warm start's come first
            f"--model.options.updates_per_epoch={given.every}",
            f"--data.evaluation_episodes={EPISODES}",
        )
        steps, scores = curves["train/env_steps"].fillna(0), curves["val/score"]
        curve = [[int(step), float(score)] for step, score in zip(steps, scores, strict=True)]
        found[seed] = {"before": curve[0][1], "after": curve[-1][1], "curve": curve}
    return found


def fit(run: Path, log: Path, *flags: str) -> pd.DataFrame:
    """The curves of a policy that is published in `run`, and is trained unless it is there."""
    if not (run / "published").exists():
        shutil.rmtree(run, ignore_errors=True)  # of a call that was interrupted
        command = [sys.executable, "-m", "envtf_lit", "agent", "fit", *flags, *QUIET]
        subprocess.run([*command, f"--data.path={log}", f"--trainer.default_root_dir={run}"], check=True)
    return pd.read_csv(run / "published/curves.csv")


if __name__ == "__main__":
    main()
