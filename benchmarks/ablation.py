"""What pays over long horizons: `python benchmarks/ablation.py OUT.json --robot hopper [--updates 6000]`.

Trains the transformer once per remedy, on the same data with as many steps per update, and measures all of them, with
the suite's three models beside them, as `envtf horizon` does: the same JSON, table and figures. What lies in the work
folder is kept, so that an interrupted run goes on where it stopped. docs/horizon.md explains the numbers.
"""

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path

from envtf_lit.files import write_json
from envtf_lit.robots.tasks import ROBOTS
from envtf_lit.studies.horizon import HorizonOptions, compare
from envtf_lit.studies.suite import WORK, SuiteOptions, add_model, build_suite
from envtf_lit.world_models.options import ModelOptions, TrainModelOptions

TOKENS = TrainModelOptions().batch_size * ModelOptions().context  # steps of each update


def variants(updates: int) -> dict[str, TrainModelOptions]:
    """Training options by name; each changes one thing of the suite's transformer, one of them two."""
    plain = TrainModelOptions(updates=updates, updates_per_epoch=min(1_000, updates))

    def model(**changes: object) -> TrainModelOptions:
        changed = replace(plain.model, **changes)
        return replace(plain, model=changed, batch_size=TOKENS // changed.context)

    return {
        "context_8": model(context=8),
        "context_32": model(context=32),
        "updates_x2": replace(plain, updates=2 * updates),
        "updates_x4": replace(plain, updates=4 * updates),
        "bounded": model(bounded=True),
        "scheduled_10": model(scheduled_sampling=0.1),
        "scheduled_50": model(scheduled_sampling=0.5),
        "scheduled_10_bounded": model(scheduled_sampling=0.1, bounded=True),
        "multi_step_2": model(multi_step=2),
        "multi_step_4": model(multi_step=4),
        "any_step_50": model(any_step=0.5),
    }


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
    parser.add_argument("--only", nargs="+", choices=variants(1), help="of the remedies; default: all")
    given = parser.parse_args()
    options = SuiteOptions(transitions=given.transitions, updates=given.updates, seed=given.seed, threads=given.threads)
    suite = build_suite(f"{given.robot}-{given.tier}", given.work, options)
    wanted = {name: train for name, train in variants(given.updates).items() if not given.only or name in given.only}
    for name, train in wanted.items():
        add_model(suite, name, train)
        sys.stdout.write(f"{name}: trained in {suite.seconds[name]:.0f} s\n")
        sys.stdout.flush()
    numbers = compare(
        given.out,
        robots=[given.robot],
        tier=given.tier,
        work=given.work,
        options=options,
        measured=HorizonOptions(given.trajectories, given.online),
        others={name: str(suite.folders[name]) for name in wanted},
    )
    write_json(given.out, numbers | suite.costs)  # the remedies', too, which are none of the suite's own models
    sys.stdout.write(given.out.with_suffix(".md").read_text())


if __name__ == "__main__":
    main()
