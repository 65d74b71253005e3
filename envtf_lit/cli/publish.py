"""What a run of `envtf model fit` or `envtf agent fit` leaves beside its logs: a model folder and the configuration."""

import itertools
import os
from pathlib import Path

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.cli import SaveConfigCallback

from envtf_lit.agents.agent import Agent
from envtf_lit.agents.store import publish_policy
from envtf_lit.cli.output import console
from envtf_lit.data.datamodules import WindowData
from envtf_lit.files import replacing
from envtf_lit.training import Curves
from envtf_lit.world_models.fit import publish_world_model
from envtf_lit.world_models.lit import LitEnsemble, LitWorldModel


class Publish(Callback):
    """Writes what was trained as a model folder, as the pipeline's stages do, beside the run's logs.

    What an earlier run published there stays, and a trial run, `fast_dev_run`, leaves nothing behind.
    """

    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        # by all processes: each may hold a part of the weights
        state, place = trainer.strategy.lightning_module_state_dict(), _folder(trainer) / "published"
        if trainer.fast_dev_run or not trainer.is_global_zero:  # pyright: ignore[reportAttributeAccessIssue]
            return
        folder = _free(place)
        curves = _curves(trainer)
        weights, row = "last update", curves.rows[-1] if curves.rows else {}
        if isinstance(pl_module, LitEnsemble):
            weights = "members at their best"
        if (checkpoint := _best(trainer)) is not None:
            saved = torch.load(checkpoint.best_model_path, map_location="cpu", weights_only=True)
            state, row = saved["state_dict"], next((r for r in curves.rows if r["epoch"] == saved["epoch"] + 1), {})
            weights = f"epoch of best {checkpoint.monitor}, {checkpoint.best_model_score:.4g}"
        module = type(pl_module)(**pl_module.hparams).to(pl_module.device)  # whole, however the other one is spread
        module.load_state_dict(state)
        settings = dict(pl_module.hparams)
        if isinstance(module, LitWorldModel):
            data: WindowData = trainer.datamodule  # pyright: ignore[reportAttributeAccessIssue]
            publish_world_model(folder, module, data, curves, row, settings)
        elif isinstance(module, Agent):
            publish_policy(folder, module.average_actor, curves, row, settings, critics=module.published_critics())
        console().print(f"Published the weights of the {weights}: {folder}")


def _curves(trainer: L.Trainer) -> Curves:
    """What was logged, as `instantiate_trainer` has it noted."""
    callbacks: list[Callback] = trainer.callbacks  # pyright: ignore[reportAttributeAccessIssue]
    return next(callback for callback in callbacks if isinstance(callback, Curves))


def _best(trainer: L.Trainer) -> ModelCheckpoint | None:
    """The callback that kept the weights of the best epoch, where one was asked to."""
    kept = (c for c in trainer.checkpoint_callbacks if isinstance(c, ModelCheckpoint) and c.monitor is not None)
    return next((c for c in kept if c.best_model_path), None)


class KeepConfig(SaveConfigCallback):
    """Writes the whole configuration to `config.yaml`, or `config_1.yaml`, …, beside the run's logs."""

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        self.folder = _folder(trainer)
        super().setup(trainer, pl_module, stage)

    def save_config(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        if trainer.fast_dev_run:  # pyright: ignore[reportAttributeAccessIssue]
            return
        with replacing(_free(self.folder / "config.yaml")) as temporary:
            self.parser.save(self.config, str(temporary), skip_none=False, multifile=False)


def _folder(trainer: L.Trainer) -> Path:
    """The run's own folder; not every logger has one. To be asked by all processes: the first tells the others."""
    return Path(trainer.log_dir or trainer.default_root_dir)


def _free(path: Path) -> Path:
    """The path, or the first of `NAME_1`, `NAME_2`, … that is not there: without a logger, runs share a folder."""
    numbered = (path.with_stem(f"{path.stem}_{number}") for number in itertools.count(1))
    return next(free for free in itertools.chain([path], numbered) if not os.path.lexists(free))
