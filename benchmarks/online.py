"""What learning online adds to a policy of a log, on Hopper: `python benchmarks/online.py [--out OUT.json]`.

An algorithm learns from the log of a project where `make repro` has run, and its policy learns on in the simulator,
once for each seed; both by `envtf agent fit`, as a user's would. A run's scores are of the same episodes before and
after. Runs that lie in the work folder are used again.
"""

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pandas as pd

from envtf_lit.devices import pick_device
from envtf_lit.files import write_json
from envtf_lit.studies.machine import facts

QUIET = ["--trainer.logger=false", "--trainer.enable_progress_bar=false", "--trainer.enable_model_summary=false"]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, metavar="FILE", help="JSON")
    parser.add_argument("--work", type=Path, default=Path(".envtf/online"), metavar="DIR")
    parser.add_argument("--project", type=Path, default=Path(), metavar="DIR", help="where `make repro` has run")
    parser.add_argument("--algorithm", default="iql", help="that it learns by, on the log and online")
    parser.add_argument("--offline-updates", type=int, default=1_500, help="on the log, once for all seeds")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--warm-start", type=int, default=1_000, help="updates of the critics alone, on the log")
    parser.add_argument("--env-steps", type=int, default=3_000, help="an update for each, after the first thousand")
    parser.add_argument("--every", type=int, default=1_000, help="updates between two looks at the policy")
    parser.add_argument("--episodes", type=int, default=10, help="of each look")
    parser.add_argument("--as-on-the-log", action="store_true", help="with the options of the log, not of online.yaml")
    given = parser.parse_args()
    runs = {seed: learn(given, seed) for seed in given.seeds}
    options = {name: value for name, value in vars(given).items() if name not in ("out", "work", "project", "seeds")}
    result = options | {"runs": runs} | facts(pick_device(), "fp32")
    if given.out is not None:
        write_json(given.out, result)
    sys.stdout.write(json.dumps(result, indent=2) + "\n")


def learn(given: argparse.Namespace, seed: int) -> dict[str, Any]:
    """Scores of one run: before the first step, after the last one, and by steps all along."""
    offline = given.work / f"{given.algorithm}-{given.offline_updates}"
    fit(given, offline, {"updates": given.offline_updates, "updates_per_epoch": given.offline_updates})
    kept = "-as-on-the-log" if given.as_on_the_log else ""
    run = given.work / f"{offline.name}{kept}-online-{given.warm_start}-{given.env_steps}-{seed}"
    updates = given.warm_start + given.env_steps
    options = {"warm_start": given.warm_start, "updates": updates, "updates_per_epoch": given.every}
    start = {"data.source": "online"} if given.as_on_the_log else {"config": "online"}
    start |= {"model.init_from": offline / "published", "model.seed": seed, "seed_everything": seed}
    start["data.evaluation_episodes"] = given.episodes
    curves = fit(given, run, options, start)
    steps, scores = curves["train/env_steps"].fillna(0), curves["val/score"]
    curve = [[int(step), round(float(score), 2)] for step, score in zip(steps, scores, strict=True)]
    return {"before": curve[0][1], "after": curve[-1][1], "curve": curve}


def fit(
    given: argparse.Namespace, run: Path, options: dict[str, int], first: dict[str, Any] | None = None
) -> pd.DataFrame:
    """The curves of a policy that is published in `run`, and is trained unless it is there."""
    if not (run / "published").exists():
        shutil.rmtree(run, ignore_errors=True)  # of a call that was interrupted
        flags = (first or {}) | {"data.path": given.project / "data/dataset.h5", "model.algorithm": given.algorithm}
        flags |= {f"model.options.{name}": value for name, value in options.items()}
        flags |= {"trainer.default_root_dir": run}
        command = [sys.executable, "-m", "envtf_lit", "agent", "fit", *QUIET]
        subprocess.run([*command, *(f"--{name}={value}" for name, value in flags.items())], check=True)
    return pd.read_csv(run / "published/curves.csv")


if __name__ == "__main__":
    main()
