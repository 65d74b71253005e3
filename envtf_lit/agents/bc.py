"""Behaviour cloning: the policy of the log, by maximum likelihood. The baseline, and who imagines first."""

import contextlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch import Tensor

from envtf_lit.data.loaders import TransitionData
from envtf_lit.imagination.options import GenerateRolloutsOptions
from envtf_lit.options.schema import Precision
from envtf_lit.policy import TanhGaussianActor
from envtf_lit.training import Curves, trained

CLONE_STEPS_PER_EPOCH = 10  # Lightning steps of 10 updates each


class BehaviourClone(L.LightningModule):
    """Maximises `log pi(a|s)` of a squashed Gaussian on (K, B, …) batches of transitions."""

    def __init__(self, actor: TanhGaussianActor, *, learning_rate: float = 0.001) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.actor, self.learning_rate = actor, learning_rate

    def training_step(self, batch: dict[str, Tensor], batch_index: int) -> None:
        optimizer: Any = self.optimizers()
        total = torch.zeros((), device=self.device)
        for observation, action in zip(batch["observations"], batch["actions"], strict=True):
            loss = -self.actor.log_prob(observation, action).mean()
            optimizer.zero_grad(set_to_none=True)
            self.manual_backward(loss)
            optimizer.step()
            total += loss.detach()
        self.log("train/loss", total / len(batch["actions"]), on_step=False, on_epoch=True, batch_size=1)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.actor.parameters(), lr=self.learning_rate)


@contextlib.contextmanager
def cloned_behaviour(
    path: Path,
    options: GenerateRolloutsOptions,
    *,
    seed: int,
    run: Path,
    target: Path,
    precision: Precision,
    progress: bool,
    held_out: float = 0.0,
) -> Iterator[tuple[TanhGaussianActor, Curves]]:
    """Fits a clone to the dataset at `path`, less a share held out, for a block that publishes it as `target`.

    `run` holds resumable checkpoints until the block has succeeded, as of `trained`.
    """
    data = TransitionData(
        str(path),
        batch_size=options.clone_batch_size,
        steps_per_epoch=CLONE_STEPS_PER_EPOCH,
        held_out=held_out,
        seed=seed,
    )
    actor = TanhGaussianActor(
        data.observation_dim,
        data.action_dim,
        action_low=data.action_low,
        action_high=data.action_high,
    )
    mean, std = data.dataset.observation_scale()
    actor.observation_mean.copy_(mean)
    actor.observation_std.copy_(std)
    updates_per_epoch = CLONE_STEPS_PER_EPOCH * data.updates_per_step
    epochs = max(1, round(options.clone_updates / updates_per_epoch))
    clone = BehaviourClone(actor)
    training = trained(
        clone, data, run=run, target=target, epochs=epochs, precision=precision, progress=progress, validate=False
    )
    with contextlib.ExitStack() as stack:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*have no `validation_step`")  # the data offer more than a clone needs
            curves = stack.enter_context(training)
        yield actor.eval(), curves
