"""The benchmark `envtf bench cost`: seconds and memory of each world model to reach the same held-out error.

The transformer, the ensemble, and one plain network with as many parameters as the transformer, each trained in a
process of its own by the recipe of its kind.
"""

import multiprocessing
import resource
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback

from envtf_lit.devices import pick_device
from envtf_lit.files import write_json
from envtf_lit.results import claim
from envtf_lit.robots.tasks import get_task
from envtf_lit.studies.machine import facts
from envtf_lit.studies.suite import WORK, SuiteOptions, build_suite, model_options
from envtf_lit.training import run_folder, trained
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.forecast import Scale, forecast, nmse, segments
from envtf_lit.world_models.lit import lit_world_model, window_data
from envtf_lit.world_models.options import EnsembleOptions, TransformerOptions
from envtf_lit.world_models.transformer import EnvironmentTransformer

MODELS = ("transformer", "ensemble", "mlp")
SEGMENTS, STEPS = 512, 20  # held-out stretches on which the error is measured


def bench_cost(
    out: Path | None = None,
    *,
    task: str = "hopper-medium-replay",
    work: Path = WORK,
    options: SuiteOptions,
    models: Sequence[str] = MODELS,
    progress: bool = True,
) -> dict[str, Any]:
    """Trains each model and finds when it first was as good as the least good of them became.

    Args:
        out: JSON file of the result; None writes none.
        task: whose zoo dataset.
        work: folder of suites, where the dataset is kept.
        options: of the data, and the budgets.
        models: which of `MODELS`.
        progress: shows bars.

    Returns:
        Flat: `target_error`, the largest of the models' least held-out errors; for each model `MODEL_seconds` to reach
        it (training alone, validation apart), `MODEL_seconds_in_all`, `MODEL_best_error`, `MODEL_parameters`,
        `MODEL_peak_memory_mb` of its process, and on an accelerator `MODEL_peak_device_memory_mb`; and the machine.

    Raises:
        UserError: an unknown task, options that contradict each other, or `out` is there and no such result.
    """
    if out is not None:
        claim(out, "target_error")
    for name in ("transformer", "ensemble"):
        model_options(name, options)  # what is wrong with the options shows before any work
    dataset = build_suite(task, work, options, models=(), progress=progress).dataset
    trials = {name: _apart(name, task, dataset, work, options, progress) for name in models}
    target = max(trial["best_error"] for trial in trials.values())
    result: dict[str, Any] = {"task": task, "transitions": options.transitions, "seed": options.seed}
    result["target_error"] = target
    for name, trial in trials.items():
        curve = trial.pop("curve")
        result[f"{name}_seconds"] = next(seconds for seconds, error in curve if error <= target)
        result |= {f"{name}_{key}": value for key, value in trial.items()}
    torch.set_num_threads(options.threads)
    result |= facts(pick_device(), options.precision)
    if out is not None:
        write_json(out, result)
    return result


def _apart(*arguments: Any) -> dict[str, Any]:
    """`_trial` in a process of its own, whose peak memory is then this model's."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        return process.submit(_trial, *arguments).result()


def _trial(name: str, task: str, dataset: Path, root: Path, options: SuiteOptions, progress: bool) -> dict[str, Any]:
    torch.set_num_threads(options.threads)
    L.seed_everything(options.seed, verbose=False)
    robot = get_task(task).robot
    train = model_options("transformer" if name == "mlp" else name, options)
    if isinstance(train, TransformerOptions) and name == "mlp":
        train = _plain(train, options.ensemble, robot.observation_dim, robot.action_dim)
    data = window_data(str(dataset), train, seed=options.seed)
    clock = Clock()
    lit = lit_world_model(robot.observation_dim, robot.action_dim, train, options.seed, compile=options.compile)
    key = {"trial": time.time_ns(), "options": asdict(train)}  # never continued: its seconds would not be known
    with trained(
        lit,
        data,
        run=run_folder(root, "bench_cost", key, []),
        target=None,
        epochs=train.updates // train.updates_per_epoch,
        precision=options.precision,
        progress=progress,
        gradient_clip=lit.gradient_clip,
        callbacks=[clock],
    ):
        pass
    trial = {
        "curve": clock.curve,
        "seconds_in_all": clock.curve[-1][0],
        "best_error": min(error for _, error in clock.curve),
        "parameters": sum(p.numel() for p in lit.best_model.parameters()),
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }
    if torch.accelerator.is_available():
        trial["peak_device_memory_mb"] = round(torch.accelerator.max_memory_allocated() / 2**20)
    return trial


class Clock(Callback):
    """Notes, at each validation, the seconds of training so far and the one-step error on held-out stretches.

    Attributes:
        curve: (seconds, error) by epoch; the error is the mean of `horizon.nmse`, the true state shown at every step.
    """

    def __init__(self) -> None:
        self.curve: list[tuple[float, float]] = []
        self.pauses = 0.0

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        data = trainer.datamodule  # pyright: ignore[reportAttributeAccessIssue]
        self.scale = Scale.of(data.train, pl_module.device)
        self.stretches = segments(data.held_out, SEGMENTS, STEPS, seed=data.seed + 1).to(pl_module.device)
        self.begin = time.perf_counter()

    def on_validation_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.paused = time.perf_counter()

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        forced = forecast(pl_module.best_model, self.stretches, feedback="recorded")  # pyright: ignore[reportArgumentType]
        error = nmse(forced.mean, self.stretches, self.scale)[self.stretches.valid].mean()
        self.curve.append((round(self.paused - self.begin - self.pauses, 1), float(error)))
        self.pauses += time.perf_counter() - self.paused


def _plain(
    transformer: TransformerOptions, ensemble: EnsembleOptions, observation_dim: int, action_dim: int
) -> EnsembleOptions:
    """One network as deep as the ensemble's, as wide as makes its parameters those of the transformer."""
    count = lambda module: sum(p.numel() for p in module.parameters())  # noqa: E731
    wanted = count(EnvironmentTransformer(observation_dim, action_dim, **vars(transformer.model)))
    layers, width = len(ensemble.hidden), 1
    network = lambda: EnsembleDynamics(observation_dim, action_dim, members=1, elites=1, hidden=(width,) * layers)  # noqa: E731
    with torch.device("meta"):  # counts without filling memory
        while count(network()) < wanted:
            width += 1
    return replace(ensemble, members=1, elites=1, hidden=(width,) * layers)
