"""The LightningModule of the world model: wires objective, optimiser and validation, nothing else."""

import math
from dataclasses import asdict
from typing import Any

import lightning as L
import torch
from torch import Tensor

from envtf_lit.data.loaders import WindowData, epoch_generator
from envtf_lit.params import ModelOptions, TrainModelOptions
from envtf_lit.storage import load_weights
from envtf_lit.world_models.horizon import Scale, open_loop_error, segments, whole_episodes
from envtf_lit.world_models.recalibration import calibration_split
from envtf_lit.world_models.transformer import EnvironmentTransformer

SELECTION_SEGMENTS, SELECTION_HORIZON = 256, 20  # open-loop stretches by which models are selected
EPISTEMIC_TOKENS = 100_000  # training rows that the last layer's posterior is fitted to, at most
CALIBRATION_EPISODES = 50  # held-out episodes that the predicted variances are scaled by, at most


class LitWorldModel(L.LightningModule):
    """Trains an Environment Transformer on windows of a log.

    Args:
        observation_dim: S.
        action_dim: A.
        options: architecture, objective and optimisation; a plain dictionary when read from a checkpoint.
        seed: of dropout and of sampled objectives.
        init_from: a published model folder whose weights to start from.
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        options: TrainModelOptions | dict[str, Any] | None = None,
        seed: int = 0,
        init_from: str | None = None,
    ) -> None:
        super().__init__()
        self.options = _train_options(options)
        self.save_hyperparameters(
            dict(observation_dim=observation_dim, action_dim=action_dim, options=asdict(self.options), seed=seed)
        )
        self.seed, self.init_from = seed, init_from
        self.model = EnvironmentTransformer(observation_dim, action_dim, **asdict(self.options.model))

    def setup(self, stage: str) -> None:
        """Takes the normaliser from the training episodes and fixes the stretches that select the model."""
        data: WindowData = self.trainer.datamodule  # pyright: ignore[reportAttributeAccessIssue]
        if self.init_from is not None:
            load_weights(self.model, f"{self.init_from}/weights.safetensors")
        else:
            self.model.normaliser.fit(data.train)
        self.scale = Scale.of(data.train, self.device)
        self.segments = segments(data.held_out, SELECTION_SEGMENTS, SELECTION_HORIZON, seed=self.seed).to(self.device)

    def fit_uncertainty(self, data: WindowData) -> None:
        """Fits the epistemic variance to training windows, then both variances' scale to half the held-out episodes.

        Once, at the end, with `data` set up.
        """
        batches = data.training_tiles(EPISTEMIC_TOKENS)
        self.model.eval().fit_epistemic(batches, generator=epoch_generator(self.seed, 0, "clusters"))
        calibration, _ = calibration_split(data.held_out)
        if calibration is not None:
            self.model.recalibrate(whole_episodes(calibration, CALIBRATION_EPISODES, seed=self.seed))

    def on_train_epoch_start(self) -> None:
        # one stream per epoch, for dropout as for sampling: a resumed run draws what an uninterrupted one would have
        torch.manual_seed(epoch_generator(self.seed, self.current_epoch, "model").initial_seed())

    def training_step(self, batch: dict[str, Tensor], batch_index: int) -> Tensor:
        loss = self.model.loss(batch)
        self.log("train/loss", loss, on_step=False, on_epoch=True, batch_size=len(batch["mask"]))
        return loss

    def validation_step(self, batch: dict[str, Tensor], batch_index: int) -> None:
        self.log("val/loss", self.model.loss(batch), batch_size=int(batch["mask"].sum()))

    def on_validation_epoch_end(self) -> None:
        error = open_loop_error(self.model, self.segments, self.scale)
        self.log("val/open_loop_error", error, prog_bar=True)

    def test_step(self, batch: dict[str, Tensor], batch_index: int) -> None:
        self.log("test/loss", self.model.loss(batch), batch_size=int(batch["mask"].sum()))

    def on_test_epoch_end(self) -> None:
        self.log("test/open_loop_error", open_loop_error(self.model, self.segments, self.scale))

    def configure_optimizers(self) -> dict[str, Any]:
        o = self.options
        matrices = [p for p in self.model.parameters() if p.dim() >= 2]
        vectors = [p for p in self.model.parameters() if p.dim() < 2]
        optimizer = torch.optim.AdamW(
            [dict(params=matrices, weight_decay=o.weight_decay), dict(params=vectors, weight_decay=0.0)],
            lr=o.learning_rate,
            eps=o.eps,
        )
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, self._rate)
        return dict(optimizer=optimizer, lr_scheduler=dict(scheduler=schedule, interval="step"))

    def _rate(self, update: int) -> float:
        """Linear warm-up, then half a cosine to zero."""
        warmup = max(1.0, self.options.warmup * self.options.updates)
        progress = min(1.0, max(0.0, (update - warmup) / max(1.0, self.options.updates - warmup)))
        return min(1.0, (update + 1) / warmup) * 0.5 * (1.0 + math.cos(math.pi * progress))


def _train_options(options: TrainModelOptions | dict[str, Any] | None) -> TrainModelOptions:
    """Options as given, or rebuilt from the plain dictionary of a checkpoint."""
    if options is None:
        return TrainModelOptions()
    if isinstance(options, TrainModelOptions):
        return options
    return TrainModelOptions(**{**options, "model": ModelOptions(**options["model"])})
