"""From a dataset file to a published world model."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from torch import nn

from envtf_lit.data.datamodules import WindowData
from envtf_lit.files import read_json, replacing
from envtf_lit.options.schema import Precision
from envtf_lit.training import Curves, record_training, run_folder, trained
from envtf_lit.world_models.forecast import Scale, forecast, median_steps_within, nmse, segments
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.world_models.lit import LitWorldModel, lit_world_model, window_data
from envtf_lit.world_models.options import WorldModelOptions
from envtf_lit.world_models.store import save_world_model
from envtf_lit.world_models.termination_head import TERMINATION, learn_termination, save_termination

REACH, TOLERATED = "open_loop_0.1_median", 0.1  # name of a model's reach, and the nmse up to which it reaches
REACH_SEGMENTS, REACH_STEPS = 100, 100  # stretches of the episodes for validation that it is taken from


def fit_world_model(
    options: WorldModelOptions,
    dataset: Path,
    target: Path,
    *,
    seed: int,
    precision: Precision,
    compile: bool,
    settings: dict[str, Any],
    root: Path = Path("."),
    progress: bool = True,
) -> dict[str, Any]:
    """Trains a world model on a dataset file and writes its folder.

    Args:
        options: of the model and its training.
        dataset: HDF5 or NPZ.
        target: folder of the weights, metrics, curves and resolved options.
        seed: of everything random; global seeds and threads are the caller's.
        precision: of matrix products in training.
        compile: trains through torch.compile.
        settings: all that the result depends on beside the dataset, the options among it: what is written as the
            resolved options, and what a killed run is found again by.
        root: below it lies what a killed run continues from.
        progress: shows a bar.

    Returns:
        Parameters, epoch of the kept weights, their held-out errors, and their `reach`; errors of the termination head,
        too, where the data are of a robot whose rule is unknown, and some episode terminates.
    """
    data = window_data(str(dataset), options, seed=seed)
    lit = lit_world_model(data.observation_dim, data.action_dim, options, seed=seed, compile=compile)
    with trained(
        lit,
        data,
        run=run_folder(root, "train_model", settings, [dataset]),
        target=target,
        epochs=options.updates // options.updates_per_epoch,
        precision=precision,
        progress=progress,
        monitor=lit.monitor,
        gradient_clip=lit.gradient_clip,
    ) as curves:
        best = curves.rows[-1] if (name := lit.monitor) is None else min(curves.rows, key=lambda row: row[name])
        return publish_world_model(target, lit, data, curves, best, settings)


def publish_world_model(
    target: Path,
    lit: LitWorldModel,
    data: WindowData,
    curves: Curves,
    best: Mapping[str, float],
    settings: dict[str, Any],
) -> dict[str, Any]:
    """Fits what comes after training, uncertainty and perhaps a termination head, and writes a world model's folder.

    Args:
        target: folder of the weights, metrics, curves and resolved options.
        lit: the `LitWorldModel` that holds the weights to keep.
        data: the `WindowData` that it was trained on, set up.
        curves: the `Curves` of the training.
        best: the row of them that belongs to the weights; it may lack what was not logged.
        settings: the resolved options.

    Returns:
        As `fit_world_model`.
    """
    lit.fit_uncertainty(data)
    names = {"epoch": "epoch", "open_loop_error": "val/open_loop_error", "val_loss": "val/loss"}
    metrics: dict[str, Any] = {"parameters": sum(p.numel() for p in lit.best_model.parameters())}
    metrics |= {name: best[column] for name, column in names.items() if column in best}
    metrics[REACH] = reach(lit.best_model, data, seed=lit.seed)
    head = learn_termination(data.train, seed=lit.seed) if data.dataset.task is None else None
    with replacing(target) as folder:
        save_world_model(folder, lit.best_model)
        if head is not None:
            save_termination(folder / TERMINATION, head)
            metrics |= head.scores(data.test)
        record_training(folder, metrics, settings, curves)
    return metrics


def reach(model: WorldModel, data: WindowData, *, seed: int) -> int:
    """Steps before a model's open loop passes an nmse of 0.1: the median over validation stretches, at most 100.

    It chooses how far policies imagine, so the episodes for testing have no part in it.

    Args:
        model: with parameters, in eval mode.
        data: set up.
        seed: of the stretches' beginnings.
    """
    device = next(cast(nn.Module, model).parameters()).device
    stretches = segments(data.validation, REACH_SEGMENTS, REACH_STEPS, seed=seed).to(device)
    error = nmse(forecast(model, stretches, feedback="imagined").mean, stretches, Scale.of(data.train, device))
    return median_steps_within(error, stretches.lengths, TOLERATED)


def known_reach(folder: Path) -> int | None:
    """The `reach` that stands in a published world model's metrics; None in a folder of an earlier version."""
    path = folder / "metrics.json"
    found = read_json(path).get(REACH) if path.exists() else None
    return int(found) if isinstance(found, int | float) else None
