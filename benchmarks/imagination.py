"""How fast the small preset imagines, and what its cache is worth: `python benchmarks/imagination.py [OUT.json]`.

Prints transitions per second of branched rollouts as the pipeline makes them (batch 4096, horizon 5, history 4) and,
at a full context of 32, the cached step against the same model run over the whole window for each step. Both sides of
the ratio take turns in one process, in the same precision.
"""

import json
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import torch

from envtf_lit.imagination import imagine
from envtf_lit.params import GenerateRolloutsOptions, ModelOptions, Params
from envtf_lit.policy import TanhGaussianActor
from envtf_lit.tasks import ROBOTS
from envtf_lit.training import autocast
from envtf_lit.world_models.transformer import EnvironmentTransformer

ROUNDS, BATCH, WINDOW_BATCH = 5, 4096, 512


def seconds(action: Callable[[], object]) -> float:
    begin = time.perf_counter()
    action()
    return time.perf_counter() - begin


def main() -> None:
    params, robot = Params(), ROBOTS["hopper"]
    torch.set_num_threads(params.threads)
    torch.manual_seed(0)
    S, A = robot.observation_dim, robot.action_dim
    model = EnvironmentTransformer(S, A, **vars(ModelOptions(context=32))).eval().requires_grad_(False)
    actor = TanhGaussianActor(S, A)
    history, horizon = GenerateRolloutsOptions().history, 5
    starts = torch.randn(BATCH, history + 1, S), torch.randn(BATCH, history, A), torch.full((BATCH,), history + 1)
    never = lambda observation: torch.zeros(len(observation), dtype=torch.bool)  # noqa: E731

    past = torch.randn(WINDOW_BATCH, 32, S), torch.randn(WINDOW_BATCH, 32, A)
    state = model.init(past[0], past[1][:, :31], torch.full((WINDOW_BATCH,), 32))
    timings: dict[str, list[float]] = {"imagine": [], "cached": [], "uncached": []}
    with torch.no_grad(), autocast(torch.device("cpu"), params.precision):
        for _ in range(ROUNDS + 1):
            timings["imagine"].append(seconds(lambda: imagine(model, actor, starts, horizon=horizon, terminated=never)))
            timings["cached"].append(seconds(lambda: model.step(state, past[1][:, -1])))
            timings["uncached"].append(seconds(lambda: model(*past)))
    typical = {name: median(values[1:]) for name, values in timings.items()}  # the first round warms up
    result = {
        "imagined_per_second": BATCH * horizon / typical["imagine"],
        "ratio_vs_uncached": typical["uncached"] / typical["cached"],
        "precision": params.precision,
        "threads": params.threads,
        "torch": torch.__version__,
        "machine": platform.machine(),
    }
    text = json.dumps(result, indent=2)
    sys.stdout.write(text + "\n")
    if len(sys.argv) > 1:
        Path(sys.argv[1]).write_text(text + "\n")


if __name__ == "__main__":
    main()
