"""The ablation study of long horizons: `python benchmarks/ablation.py OUT.json --robot hopper [--updates 6000]`.

`envtf_lit.studies.ablation` says what is trained and measured. What lies in the work folder is kept, so that an
interrupted run goes on where it stopped. docs/metrics.md explains the numbers.
"""

import argparse
import os
import sys
from pathlib import Path

from envtf_lit.robots.tasks import ROBOTS
from envtf_lit.studies.ablation import VARIANTS, run_ablation
from envtf_lit.studies.horizon import HorizonOptions
from envtf_lit.studies.suite import WORK, SuiteOptions


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--robot", choices=ROBOTS, default="hopper")
    parser.add_argument("--tier", default="medium-replay")
    parser.add_argument("--work", type=Path, default=WORK)
    parser.add_argument("--transitions", type=int, default=100_000)
    parser.add_argument("--updates", type=int, default=6_000)
    parser.add_argument("--trajectories", type=int, default=300)
    parser.add_argument("--online", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", nargs="+", choices=VARIANTS, default=list(VARIANTS), help="of the variants; all")
    given = parser.parse_args()
    run_ablation(
        given.out,
        robot=given.robot,
        tier=given.tier,
        work=given.work,
        options=SuiteOptions(
            transitions=given.transitions, updates=given.updates, seed=given.seed, threads=given.threads
        ),
        measured=HorizonOptions(given.trajectories, given.online),
        names=given.only,
    )
    sys.stdout.write(given.out.with_suffix(".md").read_text())


if __name__ == "__main__":
    main()
