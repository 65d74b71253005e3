"""Our agents beside d3rlpy's: `python benchmarks/d3rlpy/compare.py PYTHON [--out OUT.json]`.

Both learn in fp32 from the same zoo dataset of Hopper, with equal networks, options and numbers of updates (those of
`envtf bench agents`), with each of the seeds; their final actors then act in the same episodes. PYTHON is that of an
environment with d3rlpy (requirements.txt). Scores are D4RL-normalised.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, cast

import numpy as np
import torch
from torch import nn

from envtf_lit.actors import Actor, DeterministicActor
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.files import write_json
from envtf_lit.robots.returns import evaluate_policy
from envtf_lit.robots.tasks import get_task
from envtf_lit.studies.agent_speed import NETS, OPTIONS, agent_on, fit, their_side, write_plain
from envtf_lit.studies.machine import facts
from envtf_lit.zoo.collect import collect


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("python", type=Path, help="of an environment with d3rlpy")
    parser.add_argument("--out", type=Path, metavar="FILE", help="JSON")
    parser.add_argument("--task", default="hopper-medium-expert")
    parser.add_argument("--rows", type=int, default=20_000)
    parser.add_argument("--updates", type=int, default=1_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--algorithms", nargs="+", choices=OPTIONS, default=list(OPTIONS))
    given = parser.parse_args()
    torch.set_num_threads(1)
    task = get_task(given.task)
    dataset = collect(task, given.rows, seed=0, workers=1, progress=False)
    result = dict(task=task.name, rows=given.rows, updates=given.updates, seeds=given.seeds)
    with tempfile.TemporaryDirectory() as name:
        log = Path(name) / "log.h5"
        save_dataset(dataset, log)
        write_plain(dataset, log.with_suffix(".npz"), scaled=True)
        with their_side(given.python, log.with_suffix(".npz"), 1) as (versions, run):
            assert run is not None
            for algorithm in given.algorithms:
                scores: dict[str, list[float]] = {"ours": [], "d3rlpy": []}
                for seed in given.seeds:
                    agent, data = agent_on(log, algorithm, given.updates, seed)
                    fit(agent, data, "fp32")
                    job = dict(name=algorithm, seed=seed, updates=given.updates, save=str(log.with_name("actor.npz")))
                    run(job)
                    sides = dict(ours=agent.actor, d3rlpy=their_actor(Path(job["save"]), dataset))
                    for side, actor in sides.items():
                        found = evaluate_policy(actor, task.robot, episodes=given.episodes, seed=0, progress=False)
                        scores[side].append(round(float(found.scores.mean()), 2))
                result[algorithm] = compared(scores)
                sys.stdout.write(f"{algorithm} {json.dumps(result[algorithm])}\n")
                sys.stdout.flush()
    if given.out is not None:
        write_json(given.out, result | facts(torch.device("cpu"), "fp32") | versions)


def their_actor(path: Path, dataset: OfflineDataset) -> Actor:
    """d3rlpy's actor: the tanh of its last layer is the action, for observations that were z-scored beforehand."""
    actor = DeterministicActor(dataset.observation_dim, dataset.action_dim, hidden=NETS["hidden"])
    with np.load(path, allow_pickle=False) as file, torch.no_grad():
        values = [torch.from_numpy(file[name]) for name in file.files]
        layers = [cast(nn.Linear, layer) for layer in actor.net if isinstance(layer, nn.Linear)]
        for layer, weight, bias in zip(layers, values[::2], values[1::2], strict=False):  # IQL's spread may follow
            layer.weight.copy_(weight)
            layer.bias.copy_(bias)
    mean, std = dataset.observation_scale()
    actor.observation_mean.copy_(mean)
    actor.observation_std.copy_(std)
    return actor


def compared(scores: dict[str, list[float]]) -> dict[str, Any]:
    """Both sides' scores, and whether their means differ by at most the larger spread over seeds."""
    spread = max(stdev(values) if len(values) > 1 else 0.0 for values in scores.values())
    difference = fmean(scores["ours"]) - fmean(scores["d3rlpy"])
    return scores | dict(difference=difference, spread=spread, within_spread=abs(difference) <= spread)


if __name__ == "__main__":
    main()
