"""The benchmark `envtf bench model`: rates of imagination and training, beside what the world model would replace.

Every ratio compares two sides that take turns in one process on one machine, in the same precision. Weights are random:
they do not change the work. Predictive distributions have tails, as those of trained models do.
"""

import multiprocessing
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.pool import Pool
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from torch import nn

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.devices import autocast, resolved
from envtf_lit.files import write_json
from envtf_lit.imagination.histories import Histories
from envtf_lit.imagination.rollouts import imagine
from envtf_lit.options.schema import Precision
from envtf_lit.pipeline.generate_rollouts import STRETCH
from envtf_lit.pipeline.yaml import preset_params
from envtf_lit.results import claim
from envtf_lit.robots.tasks import ROBOTS, Robot
from envtf_lit.robots.termination import never_terminated
from envtf_lit.studies.machine import bench_device, facts, in_turns, ratio, seconds, typical
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.world_models.lit import LitWorldModel
from envtf_lit.world_models.options import TransformerOptions
from envtf_lit.world_models.transformer import EnvironmentTransformer

UNCACHED_CONTEXT = 32  # at which the cache is measured
TAIL = 0.6  # of every output, a usual one
CHUNK = 512  # windows that the model without its cache takes at a time
MATMUL = {"cpu": (2_048, 3)}  # size and number of the products that give the peak; elsewhere:
MATMUL_ACCELERATOR = 8_192, 20


def bench_model(
    out: Path | None = None,
    *,
    preset: str = "small",
    robot: str = "hopper",
    device: str | None = None,
    precision: Precision = "auto",
    compile: bool = False,
    threads: int = 1,
    batch: int = 4_096,
    horizon: int = 5,
    rounds: int = 5,
    real_steps: int = 2_000,
    updates: int = 20,
    windows: int | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Measures imagination and training of a preset's world model.

    Args:
        out: JSON file of the result; None writes none.
        preset: whose world model.
        robot: gives the dimensions, and the simulator.
        device: such as `cpu`; None takes the accelerator if there is one.
        precision: of matrix products, on both sides of each ratio.
        compile: all models run through torch.compile.
        threads: of the CPU, and processes of the simulator.
        batch: rollouts at a time.
        horizon: steps of each.
        rounds: in which all sides take turns; medians are reported.
        real_steps: of the simulator, per process and round.
        updates: gradient steps per round.
        windows: of a gradient step; None takes the preset's.
        seed: of weights and states.

    Returns:
        Flat; `docs/bench.md` explains each.

    Raises:
        UserError: an unknown preset or device, or `out` is there and no such result.
    """
    if out is not None:
        claim(out, "train_fraction_of_matmul_peak")
    place, body, options = bench_device(device), ROBOTS[robot], _options(preset, windows)
    warm_up = 3 if compile else 1  # what is compiled is compiled again for other shapes, and recorded at its second run
    torch.set_num_threads(threads)
    torch.manual_seed(seed)
    with torch.no_grad(), autocast(place, precision), _simulators(body, threads) as simulators:
        real = {"real": lambda: _real(simulators, threads, real_steps)}
        # held by no name: training would have to share a GPU's memory with full caches
        timings = in_turns(_imagination(body, options, place, batch, horizon, compile) | real, rounds, warm_up=warm_up)
    result = _imagination_rates(robot, timings, batch * horizon, threads * real_steps)
    result |= _learning_rates(body, options, place, precision, updates, compile, rounds, warm_up)
    result |= dict(preset=preset, batch=batch, horizon=horizon, context=options.context)
    result |= dict(windows=options.batch_size, compile=compile, seed=seed) | facts(place, precision)
    if out is not None:
        write_json(out, result)
    return result


def _options(preset: str, windows: int | None) -> TransformerOptions:
    """A preset's world model, trained on so many windows at a time; None leaves their number."""
    options = preset_params(preset).train_model["transformer"]
    assert isinstance(options, TransformerOptions)
    return replace(options, batch_size=windows or options.batch_size)


def _imagination_rates(robot: str, timings: list[dict[str, float]], steps: int, real_steps: int) -> dict[str, Any]:
    """Steps per second, and ratios of rates, where a round imagines `steps` and simulates `real_steps`."""
    return {
        "imagined_per_second": steps / typical(timings, "short"),
        "imagined_per_second_full": steps / typical(timings, "full"),
        "imagined_per_second_from_history": steps / typical(timings, "history"),
        "imagined_per_second_from_shared_history": steps / typical(timings, "shared"),
        "ensemble_per_second": steps / typical(timings, "ensemble"),
        f"{robot}_steps_per_second": real_steps / typical(timings, "real"),
        "ratio_vs_ensemble_short": ratio(timings, "ensemble", "short"),
        "ratio_vs_ensemble_full": ratio(timings, "ensemble_steps", "full"),
        f"ratio_vs_{robot}": ratio(timings, "real", "short") * steps / real_steps,
        "ratio_vs_uncached": ratio(timings, "uncached", "cached"),
    }


def _learning_rates(
    robot: Robot,
    options: TransformerOptions,
    device: torch.device,
    precision: Precision,
    updates: int,
    compile: bool,
    rounds: int,
    warm_up: int,
) -> dict[str, float]:
    """Tokens per second of training, and the share of a matrix product's rate that they reach."""
    train, flops = _training(robot, options, device, precision, updates, compile)
    timings = in_turns({"train": train, "matmul": _matmul(device, precision)}, rounds, warm_up=warm_up)
    (size, repeats), tokens = _matmul_size(device), updates * options.batch_size * options.context
    return {
        "train_tokens_per_second": tokens / typical(timings, "train"),
        "matmul_peak_gflops": 2e-9 * size**3 * repeats / typical(timings, "matmul"),
        "train_fraction_of_matmul_peak": ratio(timings, "matmul", "train") * tokens * flops / (2 * size**3 * repeats),
    }


def _imagination(
    robot: Robot, options: TransformerOptions, device: torch.device, batch: int, horizon: int, compile: bool
) -> dict[str, Callable[[], float]]:
    """Rollouts from single states by both models; their steps alone, the transformer's cache full; and `_cache`."""
    S, A, context = robot.observation_dim, robot.action_dim, options.context
    transformer = _frozen(EnvironmentTransformer(S, A, **vars(options.model)), device, compile)
    ensemble = _frozen(EnsembleDynamics(S, A), device, compile)
    actor = TanhGaussianActor(S, A).to(device)
    single, past = _histories(robot, batch, 1, device), _histories(robot, batch, context, device)

    shared = _shared_histories(robot, batch, context, device)

    def rollouts(model: WorldModel, histories: Histories) -> Callable[[], float]:
        run = lambda: imagine(model, actor, histories, horizon=horizon, terminated=never_terminated, batch_size=batch)  # noqa: E731
        return lambda: seconds(run, device)

    return {
        "short": rollouts(transformer, single),
        "ensemble": rollouts(ensemble, single),
        "history": rollouts(transformer, past),
        "shared": rollouts(transformer, shared),
        "full": _steps(transformer, past.begin(transformer), actor, horizon, device),
        "ensemble_steps": _steps(ensemble, single.begin(ensemble), actor, horizon, device),
        **_cache(robot, options, device, batch, compile),
    }


def _steps(
    model: WorldModel, state: Any, actor: TanhGaussianActor, horizon: int, device: torch.device
) -> Callable[[], float]:
    """Sampled steps of a rollout that is under way."""

    def run() -> None:
        nonlocal state
        for _ in range(horizon):
            state, _ = model.step(state, actor.act(model.current(state)), mode="sample")

    return lambda: seconds(run, device)


def _cache(
    robot: Robot, options: TransformerOptions, device: torch.device, batch: int, compile: bool
) -> dict[str, Callable[[], float]]:
    """One step of all rollouts where the window is full: with the cache, and by a pass over the whole window."""
    wide = vars(options.model) | {"context": UNCACHED_CONTEXT}
    model = _frozen(EnvironmentTransformer(robot.observation_dim, robot.action_dim, **wide), device, compile)
    encode = torch.compile(model.encode) if compile else model.encode
    seen = _histories(robot, batch, UNCACHED_CONTEXT, device)
    observations, actions = seen.observations, seen.actions
    state, action = seen.begin(model), torch.randn(batch, robot.action_dim, device=device)
    windows = observations.split(CHUNK), torch.cat([actions, action[:, None]], 1).split(CHUNK)

    def cached() -> None:
        nonlocal state
        state, _ = model.step(state, action)
        state = model.observe(state, observations[:, -1])

    def uncached() -> None:
        for past, done in zip(*windows, strict=True):
            hidden, _ = encode(past, done, cached=False)
            model.predict(hidden[:, -1], model.normaliser.token(past[:, -1], done[:, -1]), past[:, -1])

    return {"cached": lambda: seconds(cached, device), "uncached": lambda: seconds(uncached, device)}


def _histories(robot: Robot, batch: int, length: int, device: torch.device) -> Histories:
    """Histories of random numbers."""
    observations = torch.randn(batch, length, robot.observation_dim, device=device)
    actions = torch.randn(batch, length - 1, robot.action_dim, device=device)
    return Histories(observations, actions, torch.full((batch,), length, device=device))


def _shared_histories(robot: Robot, batch: int, length: int, device: torch.device) -> Histories:
    """The same where `STRETCH` rollouts begin in each window, one step apart."""
    windows = -(-batch // STRETCH)
    seen = _histories(robot, windows, length + STRETCH - 1, device)
    branch = torch.arange(batch, device=device)
    return Histories(seen.observations, seen.actions, length + branch % STRETCH, branch // STRETCH)


def _frozen(model: Any, device: torch.device, compile: bool) -> Any:
    if isinstance(model, EnvironmentTransformer):
        model.tail.fill_(TAIL)
    if compile:
        model.fuse()
    return model.to(device).eval().requires_grad_(False)


def _training(
    robot: Robot,
    options: TransformerOptions,
    device: torch.device,
    precision: Precision,
    updates: int,
    compile: bool,
) -> tuple[Callable[[], float], int]:
    """Gradient steps as the pipeline takes them, loading apart, and the floating-point operations of a token in them.

    Those are 6 for each weight of a matrix: 2 forward, 4 backward. Attention's own products are left out.
    """
    module = LitWorldModel(robot.observation_dim, robot.action_dim, options, compile=compile).to(device)
    optimizer = module.configure_optimizers()["optimizer"]
    shape = options.batch_size, options.context
    batch = {
        "observations": torch.randn(*shape, robot.observation_dim, device=device),
        "actions": torch.randn(*shape, robot.action_dim, device=device),
        "next_observations": torch.randn(*shape, robot.observation_dim, device=device),
        "rewards": torch.randn(shape, device=device),
        "mask": torch.ones(shape, device=device),
    }

    def run() -> None:
        for _ in range(updates):
            optimizer.zero_grad()
            with autocast(device, precision):
                loss = module.loss(batch)
            loss.backward()
            nn.utils.clip_grad_norm_(module.model.parameters(), options.gradient_clip)
            optimizer.step()

    weights = sum(p.numel() for p in module.model.parameters() if p.dim() >= 2)
    return lambda: seconds(run, device), 6 * weights


def _matmul_size(device: torch.device) -> tuple[int, int]:
    return MATMUL.get(device.type, MATMUL_ACCELERATOR)


def _matmul(device: torch.device, precision: Precision) -> Callable[[], float]:
    size, repeats = _matmul_size(device)
    dtype = {"fp32": torch.float32, "bf16": torch.bfloat16}[resolved(precision, device)]
    matrix = torch.randn(size, size, device=device, dtype=dtype)

    def run() -> None:
        for _ in range(repeats):
            torch.mm(matrix, matrix)

    return lambda: seconds(run, device)


def _simulators(robot: Robot, processes: int) -> Pool:
    """Processes that hold the real robot."""
    return multiprocessing.get_context("spawn").Pool(processes, _make_real, (robot.name,))


def _real(pool: Pool, processes: int, steps: int) -> float:
    """Seconds in which every process takes that many steps, all at the same time, resets apart."""
    return fmean(pool.map(_step_real, [steps] * processes, chunksize=1))


def _make_real(robot: str) -> None:
    global _environment
    _environment = ROBOTS[robot].make()
    _environment.action_space.seed(0)
    _environment.reset(seed=0)


def _step_real(steps: int) -> float:
    spent = 0.0
    for _ in range(steps):
        action = _environment.action_space.sample()
        begin = time.perf_counter()
        _, _, terminated, truncated, _ = _environment.step(action)
        spent += time.perf_counter() - begin
        if terminated or truncated:
            _environment.reset()
    return spent
