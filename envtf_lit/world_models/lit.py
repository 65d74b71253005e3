"""LightningModules that train the world models: they wire objective, optimiser and validation, nothing else."""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, ClassVar, cast

import lightning as L
import torch
from torch import Tensor

from envtf_lit import training
from envtf_lit.data.datamodules import WindowData
from envtf_lit.data.loaders import epoch_generator
from envtf_lit.divergence import Bound, diverged
from envtf_lit.errors import UserError
from envtf_lit.options.schema import build
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.finetuning import start_from
from envtf_lit.world_models.forecast import Scale, open_loop_error, segments, whole_episodes
from envtf_lit.world_models.options import EnsembleOptions, TransformerOptions, WorldModelOptions
from envtf_lit.world_models.store import load_world_model
from envtf_lit.world_models.transformer import EnvironmentTransformer

SELECTION_SEGMENTS, SELECTION_HORIZON = 256, 20  # open-loop stretches by which models are selected
EPISTEMIC_TOKENS = 100_000  # training rows that epistemic variance is fitted to, at most
CALIBRATION_EPISODES = 50  # held-out episodes that the predicted variances are scaled by, at most
SINGULAR = "since hidden tokens are too large for its inverse"
EXPLODED = 1e4  # a mean loss over z-scored targets
IMPROVEMENT = 0.01  # of a member's held-out error, below which it counts as none


def lit_world_model(
    observation_dim: int,
    action_dim: int,
    options: WorldModelOptions,
    seed: int = 0,
    init_from: str | None = None,
    freeze: Sequence[str] = (),
    compile: bool = False,
) -> "LitWorldModel":
    """LightningModule of the kind of model that the options are of."""
    kind = LitWorldModel if isinstance(options, TransformerOptions) else LitEnsemble
    return kind(observation_dim, action_dim, options, seed, init_from, freeze, compile)


def window_data(path: str, options: WorldModelOptions, *, seed: int) -> WindowData:
    """The data module of windows that such options are trained on."""
    return WindowData(path, **window_options(options), seed=seed)


def window_options(options: WorldModelOptions) -> dict[str, Any]:
    """Arguments of `WindowData`; an ensemble wants windows of one step, as many batches as members."""
    single = isinstance(options, EnsembleOptions)
    return dict(
        context=1 if single else options.context,
        batch_size=options.batch_size,
        updates_per_epoch=options.updates_per_epoch,
        members=options.members if single else None,
    )


class LitWorldModel(L.LightningModule):
    """LightningModule that trains an Environment Transformer on windows of a log.

    Attributes:
        label: its name in messages.
        bounds: of logged metrics; see `divergence.check_epoch`.
        monitor: logged name by which the best weights are selected, or None where the module selects them itself.

    Args:
        observation_dim: S.
        action_dim: A.
        options: architecture, objective and optimisation; a plain dictionary when read from a checkpoint.
        seed: of dropout and of sampled objectives.
        init_from: a published model folder whose weights to start from; see `finetuning.start_from`.
        freeze: parts of the model that stay as they are, such as `blocks`.
        compile: fuses the operations of the training loss, which pays on a GPU.
    """

    Options: ClassVar[type[WorldModelOptions]] = TransformerOptions
    label: ClassVar[str] = "The transformer"
    bounds: ClassVar[Mapping[str, Bound]] = {
        "train/loss": Bound(EXPLODED, "and a model that knows nothing has about 1")
    }
    monitor: str | None = "val/open_loop_error"

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        options: WorldModelOptions | dict[str, Any] | None = None,
        seed: int = 0,
        init_from: str | None = None,
        freeze: Sequence[str] = (),
        compile: bool = False,
    ) -> None:
        super().__init__()
        plain = dict(options) if isinstance(options, Mapping) else asdict(options or self.Options())
        self.options: Any = build(self.Options, plain, "")
        self.save_hyperparameters(
            dict(
                observation_dim=observation_dim,
                action_dim=action_dim,
                options=asdict(self.options),
                seed=seed,
                freeze=list(freeze),
            )
        )
        self.seed, self.init_from = seed, init_from
        self.model: EnvironmentTransformer | EnsembleDynamics = self._build(observation_dim, action_dim)
        training.freeze(self.model, freeze)
        # "reduce-overhead" replays the kernels of all batches of a shape as one recorded graph
        self.loss = torch.compile(self.model.loss, mode="reduce-overhead") if compile else self.model.loss

    def _build(self, observation_dim: int, action_dim: int) -> EnvironmentTransformer | EnsembleDynamics:
        return EnvironmentTransformer(observation_dim, action_dim, **asdict(self.options.model))

    @property
    def best_model(self) -> EnvironmentTransformer | EnsembleDynamics:
        """The world model that is validated, and published once training is over."""
        return self.model

    @property
    def gradient_clip(self) -> float | None:
        """Largest gradient norm."""
        return self.options.gradient_clip

    def setup(self, stage: str) -> None:
        """Takes the normaliser from the training episodes and fixes the stretches that select the model."""
        data: WindowData = self.trainer.datamodule  # pyright: ignore[reportAttributeAccessIssue]
        self.model.normaliser.fit(data.train)
        if self.init_from is not None:
            self._start_from(self.init_from)
        self.scale = Scale.of(data.train, self.device)
        episodes = data.test if stage == "test" else data.validation
        self.segments = segments(episodes, SELECTION_SEGMENTS, SELECTION_HORIZON, seed=self.seed).to(self.device)

    def _start_from(self, folder: str) -> None:
        try:
            start_from(self.model, load_world_model(folder))
        except UserError as error:
            raise UserError(f"{folder} does not fit the model: {error}") from None

    def fit_uncertainty(self, data: WindowData) -> None:
        """Fits the epistemic variance to training windows, then both variances' scale to the episodes for validation.

        Once, at the end, with `data` set up.

        Raises:
            UserError: the hidden tokens are so large that there is no posterior.
        """
        try:
            self._fit_epistemic(data)
        except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage]
            raise diverged(self.label, "in its training", "the posterior's precision", math.nan, SINGULAR) from None
        if len(data.held_out.episode_starts) > 1:  # or the one that is tested on would be fitted to
            model = cast(EnvironmentTransformer, self.model)  # the ensemble's module has its own way
            model.recalibrate(whole_episodes(data.validation, CALIBRATION_EPISODES, seed=self.seed))

    def _fit_epistemic(self, data: WindowData) -> None:
        batches = data.training_tiles(EPISTEMIC_TOKENS)
        self.best_model.eval().fit_epistemic(batches, generator=epoch_generator(self.seed, 0, "clusters"))

    def on_train_epoch_start(self) -> None:
        # one stream per epoch, for dropout as for sampling: a resumed run draws what an uninterrupted one would have
        stream = f"model{self.global_rank or ''}"
        torch.manual_seed(epoch_generator(self.seed, self.current_epoch, stream).initial_seed())

    def training_step(self, batch: dict[str, Tensor], batch_index: int) -> Tensor:
        loss = self.loss(batch) * self._process_weight(batch["mask"])
        self.log("train/loss", loss, on_step=False, on_epoch=True, batch_size=len(batch["mask"]), sync_dist=True)
        return loss

    def _process_weight(self, mask: Tensor) -> Tensor | float:
        """Of this process's mean loss per token, so that the mean over processes is that over all tokens."""
        if self.trainer.world_size == 1:
            return 1.0
        tokens = mask.sum()
        return tokens / self.trainer.strategy.reduce(tokens.clone(), reduce_op="mean")

    def validation_step(self, batch: dict[str, Tensor], batch_index: int) -> None:
        self._log_errors("val", batch, batch_index)

    def test_step(self, batch: dict[str, Tensor], batch_index: int) -> None:
        self._log_errors("test", batch, batch_index)

    def _log_errors(self, split: str, batch: dict[str, Tensor], batch_index: int) -> None:
        """Logs the batch's loss, and once the open-loop error: in a step, where a model spread over GPUs is whole."""
        tokens = int(batch["mask"].sum())
        self.log(f"{split}/loss", self.best_model.loss(batch), batch_size=tokens, sync_dist=True)
        if batch_index == 0:
            with torch.autocast(self.device.type, enabled=False):  # as the saved model is evaluated
                error = open_loop_error(self.best_model, self.segments, self.scale)
            self.log(f"{split}/open_loop_error", error, prog_bar=split == "val", batch_size=1, sync_dist=True)

    @property
    def _scales_gradients(self) -> bool:
        """Whether fp16 does so. An optimiser that makes its step in one pass would undo it, but after the clipping."""
        return self._trainer is not None and getattr(self.trainer.precision_plugin, "scaler", None) is not None

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: int | float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """As Lightning clips, but for one-pass optimisers too, which it refuses even where nothing is scaled (bf16)."""
        if self._scales_gradients:
            self.clip_gradients(optimizer, gradient_clip_val, gradient_clip_algorithm)
        elif gradient_clip_val:
            plugin = self.trainer.precision_plugin
            clip = plugin.clip_grad_by_value if gradient_clip_algorithm == "value" else plugin.clip_grad_by_norm
            clip(optimizer, gradient_clip_val)

    def configure_optimizers(self) -> dict[str, Any]:
        o = self.options
        matrices, vectors = [], []
        for name, parameter in self.model.named_parameters():  # by name: spread over GPUs, all of them are flat
            (matrices if name.endswith("weight") and "norm" not in name else vectors).append(parameter)
        optimizer = torch.optim.AdamW(
            [dict(params=matrices, weight_decay=o.weight_decay), dict(params=vectors, weight_decay=0.0)],
            lr=o.learning_rate,
            eps=o.eps,
            fused=not self._scales_gradients,
        )
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, self._rate)
        return dict(optimizer=optimizer, lr_scheduler=dict(scheduler=schedule, interval="step"))

    def _rate(self, update: int) -> float:
        """Linear warm-up, then half a cosine to zero."""
        warmup = max(1.0, self.options.warmup * self.options.updates)
        progress = min(1.0, max(0.0, (update - warmup) / max(1.0, self.options.updates - warmup)))
        return min(1.0, (update + 1) / warmup) * 0.5 * (1.0 + math.cos(math.pi * progress))


class LitEnsemble(LitWorldModel):
    """LightningModule that trains an ensemble on bootstrap resamples until no member's held-out error falls.

    The recipe is MBPO's. Each member is kept as it was when its own error was least. Arguments as of `LitWorldModel`.
    """

    model: EnsembleDynamics  # pyright: ignore[reportIncompatibleVariableOverride]
    Options = EnsembleOptions
    label = "The ensemble"
    monitor = None
    best_error: Tensor
    stale: Tensor

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        options: WorldModelOptions | dict[str, Any] | None = None,
        seed: int = 0,
        init_from: str | None = None,
        freeze: Sequence[str] = (),
        compile: bool = False,
    ) -> None:
        super().__init__(observation_dim, action_dim, options, seed, init_from, freeze, compile)
        self.best = copy.deepcopy(self.model).requires_grad_(False)  # a module, so that checkpoints hold it
        self.register_buffer("best_error", torch.full((self.options.members,), torch.inf))
        self.register_buffer("stale", torch.zeros((), dtype=torch.int64))  # epochs since a member improved

    def _build(self, observation_dim: int, action_dim: int) -> EnsembleDynamics:
        o = self.options
        return EnsembleDynamics(observation_dim, action_dim, members=o.members, elites=o.elites, hidden=o.hidden)

    @property
    def best_model(self) -> EnsembleDynamics:
        """The members, each as it was when its own held-out error was least."""
        return self.best

    @property
    def gradient_clip(self) -> None:
        """The recipe has none."""

    def setup(self, stage: str) -> None:
        """As for the transformer; the best members begin as the trained ones."""
        super().setup(stage)
        self.best.load_state_dict(self.model.state_dict())

    def fit_uncertainty(self, data: WindowData) -> None:
        """Fits the limit of novelty to training windows; the variances stay what the recipe makes them."""
        self._fit_epistemic(data)

    def on_fit_start(self) -> None:
        self._stop_when_stale()  # a run may have been killed just after it stopped

    def _stop_when_stale(self) -> None:
        if int(self.stale) >= self.options.patience:
            self.trainer.should_stop = True

    def training_step(self, batch: dict[str, Tensor], batch_index: int) -> Tensor:
        loss = self.loss(batch)
        self.log("train/loss", loss / self.options.members, on_step=False, on_epoch=True, batch_size=1)
        return loss + self.model.decay(self.options.weight_decay)

    def on_validation_epoch_start(self) -> None:
        self.squared, self.entries = torch.zeros_like(self.best_error), torch.zeros_like(self.best_error[0])

    def validation_step(self, batch: dict[str, Tensor], batch_index: int) -> None:
        model = self.model if self.trainer.state.fn == "fit" else self.best
        with torch.autocast(self.device.type, enabled=False):  # members are ranked by it
            squared, entries = model.squared_error(batch)
        self.squared, self.entries = self.squared + squared, self.entries + entries

    def on_validation_epoch_end(self) -> None:
        error = self.squared / self.entries
        self.log("val/loss", error.mean())
        if self.trainer.state.fn == "fit":
            self._update_best(error)
            self._stop_when_stale()
        self.log("val/open_loop_error", open_loop_error(self.best_model, self.segments, self.scale), prog_bar=True)

    def _update_best(self, error: Tensor) -> None:
        """Takes over the members that improved, given the held-out errors of all (M,)."""
        improved = error < (1.0 - IMPROVEMENT) * self.best_error
        self.best.adopt(self.model, improved)
        self.best_error = torch.where(improved, error, self.best_error)
        self.best.elite.copy_(self.best_error.argsort()[: self.options.elites])
        self.stale = torch.where(improved.any(), 0, self.stale + 1)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.model.parameters(), lr=self.options.learning_rate, fused=True)
