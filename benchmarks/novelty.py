"""Detection of out-of-distribution pairs: `python benchmarks/novelty.py --out OUT.json --robots hopper ant`.

First the posterior of the last layer, with more or fewer random features beside the hidden token. Then random-prior
heads (Osband et al. 2018): ten small networks on the hidden token, each with a fixed random network of its own added,
which learn the transformer's training residuals; where they disagree, data were lacking. Measured as `envtf calibrate`
measures, on the same pairs. The suite's transformer is taken from the work folder, or trained.
"""

import argparse
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from envtf_lit.data.loaders import Windows
from envtf_lit.evaluation.calibration import Points, auroc
from envtf_lit.files import write_json
from envtf_lit.robots.tasks import ROBOTS, Task, get_task
from envtf_lit.studies.calibration import CalibrationData, CalibrationOptions
from envtf_lit.studies.suite import WORK, Suite, SuiteOptions, build_suite, result_header
from envtf_lit.world_models.lit import LitWorldModel, window_data
from envtf_lit.world_models.options import TransformerOptions
from envtf_lit.world_models.store import load_world_model
from envtf_lit.world_models.transformer import EnvironmentTransformer

HEADS, HIDDEN, UPDATES, BATCH, ROWS = 10, 128, 2_000, 256, 50_000  # of the random priors


class Networks(nn.Module):
    """`HEADS` networks of one hidden layer, side by side."""

    def __init__(self, inputs: int, outputs: int, generator: torch.Generator) -> None:
        super().__init__()
        self.first = nn.Parameter(torch.randn(HEADS, inputs, HIDDEN, generator=generator) * inputs**-0.5)
        self.bias = nn.Parameter(torch.randn(HEADS, 1, HIDDEN, generator=generator))
        self.second = nn.Parameter(torch.randn(HEADS, HIDDEN, outputs, generator=generator) * HIDDEN**-0.5)

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs) to (HEADS, N, outputs)."""
        return torch.tanh(x @ self.first + self.bias) @ self.second


def tokens(model: EnvironmentTransformer, points: Points) -> tuple[Tensor, Tensor]:
    """Last hidden tokens (N, D), and the normalised pairs (N, S + A) they end in."""
    last, rows = points.histories.lengths - 1, torch.arange(len(points.actions))
    actions = nn.functional.pad(points.histories.actions, (0, 0, 0, 1))
    actions[rows, last] = points.actions
    with torch.no_grad():
        parts = zip(points.histories.observations.split(1_024), actions.split(1_024), strict=True)
        hidden = torch.cat([model.encode(*part, cached=False)[0] for part in parts])[rows, last]
        return hidden, model.normaliser.token(points.histories.observations[rows, last], points.actions)


def train(
    model: EnvironmentTransformer, windows: Windows, weight: float, generator: torch.Generator
) -> tuple[Networks, Networks]:
    """The networks that learn, and those that stay random, `weight` times which is added."""
    tiles = windows.tiles()
    tiles = tiles[torch.randperm(len(tiles), generator=generator)[: ROWS // model.options.context]]
    batch = windows[tiles]
    valid = batch["mask"].bool()
    with torch.no_grad():
        hidden = model.encode(batch["observations"], batch["actions"], cached=False)[0][valid]
        token = model.normaliser.token(batch["observations"], batch["actions"])[valid]
        target = model.normaliser.target(batch["observations"], batch["next_observations"], batch["rewards"])[valid]
        residual = target - model.heads(hidden)[0]
    learner = Networks(hidden.shape[1], residual.shape[1], generator)
    prior = Networks(token.shape[1], residual.shape[1], generator).requires_grad_(False)
    optimizer = torch.optim.Adam(learner.parameters(), lr=0.001)
    for _ in range(UPDATES):
        rows = torch.randint(len(hidden), (BATCH,), generator=generator)
        error = learner(hidden[rows]) + weight * prior(token[rows]) - residual[rows]
        optimizer.zero_grad()
        error.square().mean((1, 2)).sum().backward()
        optimizer.step()
    return learner, prior


def refit(model: EnvironmentTransformer, suite: Suite, count: int) -> EnvironmentTransformer:
    """The same network with a posterior that sees so many random features, fitted as after training."""
    options = TransformerOptions(**vars(replace(model.options, random_features=count)))
    data = window_data(str(suite.dataset), options, seed=suite.options.seed)
    data.setup("fit")
    lit = LitWorldModel(model.observation_dim, model.action_dim, options, suite.options.seed)
    assert isinstance(lit.model, EnvironmentTransformer)
    anew = ("random_features.", "laplace.")
    lit.model.load_state_dict({k: v for k, v in model.state_dict().items() if not k.startswith(anew)}, strict=False)
    lit.fit_uncertainty(data)
    return lit.model.eval()


@torch.no_grad()
def milliseconds(model: EnvironmentTransformer, points: Points, repeats: int = 20) -> float:
    """Median wall time of the posterior's part of a step, for as many pairs as there are points."""
    hidden, token = tokens(model, points)
    assert model.laplace is not None
    taken = []
    for _ in range(repeats):
        begin = time.perf_counter()
        model.laplace.leverage(model.posterior_inputs(hidden, token))
        taken.append(time.perf_counter() - begin)
    return round(1e3 * float(np.median(taken)), 2)


@torch.no_grad()
def spread(
    model: EnvironmentTransformer, learner: Networks, prior: Networks, weight: float, points: Points
) -> np.ndarray:
    """(N,) variance over the heads, mean over the outputs."""
    hidden, token = tokens(model, points)
    return (learner(hidden) + weight * prior(token)).var(0).mean(-1).numpy()


def measure(task: Task, suite: Suite, given: argparse.Namespace) -> Iterator[dict[str, float]]:
    """One robot's numbers, kind by kind."""
    model = load_world_model(suite.folders["transformer"])
    assert isinstance(model, EnvironmentTransformer)
    data = CalibrationData(task, suite, CalibrationOptions(), True)
    for count in given.features:
        other = refit(model, suite, count)
        numbers, _ = data.detection(other)
        numbers |= {"rank_correlation": data.rollouts(other)[0]["rank_correlation"]}
        assert other.laplace is not None
        numbers |= {"scale": float(other.laplace.scale), "milliseconds": milliseconds(other, data.in_distribution)}
        yield {f"{task.robot.name}.features_{count}.{name}": value for name, value in numbers.items()}
    windows = Windows(suite.split()[0], model.options.context)
    for weight in given.weights:
        begin = time.perf_counter()
        learner, prior = train(model, windows, weight, torch.Generator().manual_seed(given.seed))
        inside = spread(model, learner, prior, weight, data.in_distribution)
        numbers = {
            f"auroc_{contrast}": auroc(inside, spread(model, learner, prior, weight, points))
            for contrast, points in data.out_of_distribution.items()
        } | {"seconds": round(time.perf_counter() - begin, 1)}
        yield {f"{task.robot.name}.priors_{weight:g}.{name}": value for name, value in numbers.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="JSON, written as it grows")
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=list(ROBOTS))
    parser.add_argument("--tier", default="medium")
    parser.add_argument("--work", type=Path, default=WORK, metavar="DIR")
    parser.add_argument("--transitions", type=int, default=100_000)
    parser.add_argument("--updates", type=int, default=6_000, help="of the transformer")
    parser.add_argument("--features", type=int, nargs="*", default=[0, 64, 128, 256, 512, 1024], help="random ones")
    parser.add_argument("--weights", type=float, nargs="*", default=[0.3, 1.0, 3.0], help="of the random networks")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    options = SuiteOptions(transitions=given.transitions, updates=given.updates, seed=given.seed, threads=given.threads)
    result = result_header(given.tier, options, calibration=CalibrationOptions())
    for robot in given.robots:
        task = get_task(f"{robot}-{given.tier}")
        suite = build_suite(task.name, given.work, options, models=("transformer",))
        for numbers in measure(task, suite, given):
            result |= numbers
            write_json(given.out, result)
            print(numbers)


if __name__ == "__main__":
    main()
