"""What a run of `envtf model fit` or `envtf agent fit` leaves beside its logs: a model folder and the configuration."""

from pathlib import Path

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.cli import SaveConfigCallback

from envtf_lit.agents.cql import CQL
from envtf_lit.agents.store import publish_policy
from envtf_lit.cli.output import console
from envtf_lit.data.loaders import WindowData
from envtf_lit.files import replacing
from envtf_lit.training import Curves
from envtf_lit.world_models.fit import publish_world_model
from envtf_lit.world_models.lit import LitEnsemble, LitWorldModel


class Publish(Callback):
    """Writes what was trained as a model folder, as the pipeline's stages do, beside the run's logs."""

    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        # by all processes: each may hold a part of the weights
        state, folder = trainer.strategy.lightning_module_state_dict(), _folder(trainer) / "published"
        if not trainer.is_global_zero:
            return
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
        elif isinstance(module, CQL):
            publish_policy(folder, module.average_actor, curves, row, settings)
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
    """Writes the whole configuration to `config.yaml` beside the run's logs, wherever the logger keeps them."""

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        self.folder = _folder(trainer)
        super().setup(trainer, pl_module, stage)

    def save_config(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        with replacing(self.folder / "config.yaml") as temporary:
            self.parser.save(self.config, str(temporary), skip_none=False, multifile=False)


def _folder(trainer: L.Trainer) -> Path:
    """The run's own folder; not every logger has one. To be asked by all processes: the first tells the others."""
    return Path(trainer.log_dir or trainer.default_root_dir)
