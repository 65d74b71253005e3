"""The loop that every agent is trained by: several updates per training step, optimisers by name, scales, resuming."""

from typing import Any

import torch
from torch import Tensor, nn

from envtf_lit import training
from envtf_lit.agents.algorithm import Algorithm
from envtf_lit.agents.phases import Batch, Logs
from envtf_lit.agents.scales import LogReturns, scale_observations
from envtf_lit.data.datamodules import TransitionData
from envtf_lit.data.loaders import epoch_generator
from envtf_lit.errors import UserError
from envtf_lit.policy import load_policy


class Agent(Algorithm):
    """An algorithm and how its parts are updated, several times per training step.

    A batch holds (K, B, …) transitions for K gradient steps; there is no host synchronisation between them. Arguments
    as of `Algorithm`.
    """

    # One gradient step

    def descend(self, part: str, loss: Tensor, *, rate: float | None = None, clip: float | None = None) -> None:
        """One step of a part's optimiser, at another learning rate and with its gradient's norm clipped if wanted."""
        optimizer = self.optimizer(part)
        if rate is not None:
            optimizer.param_groups[0]["lr"] = rate
        optimizer.zero_grad(set_to_none=True)
        self.manual_backward(loss)
        if clip is not None:
            # not by Lightning, whose clipping refuses fused optimisers
            nn.utils.clip_grad_norm_(self.parts()[part].module.parameters(), clip)
        optimizer.step()

    def optimizer(self, part: str) -> Any:
        """The optimiser of a part, by its name."""
        optimizers: list[Any] = self.optimizers(use_pl_optimizer=True)  # pyright: ignore[reportAssignmentType]
        optimizers = optimizers if isinstance(optimizers, list) else [optimizers]
        return optimizers[list(self.parts()).index(part)]

    def in_units(self, batch: Batch) -> Batch:
        """Rows of the log with rewards and returns as they are learned."""
        return batch | {name: batch[name] / self.return_scale for name in ("rewards", "returns")}

    def update(self, batch: Batch) -> Logs:
        """One update in the phase that is under way; returns detached scalars to log."""
        batch = self.in_units(batch) | {"real": torch.ones_like(batch["rewards"])}
        done = self.update_index
        for phase in self.phases:
            if done < phase.updates:
                return phase.update(self, batch, done)
            done -= phase.updates
        last = next(phase for phase in reversed(self.phases) if phase.updates > 0)
        return last.update(self, batch, last.updates - 1)  # asked for more than planned

    # Lightning hooks

    def setup(self, stage: str) -> None:
        """Takes scales from the dataset, the actor's layers from `init_from`, and the stored rollouts."""
        data: TransitionData = self.trainer.datamodule  # pyright: ignore[reportAttributeAccessIssue]
        scale_observations(self, *data.dataset.observation_scale())
        if self.init_from is not None:
            self._start_from(self.init_from)
        self.log_returns = LogReturns.of(data, self.options.discount)
        if self.options.normalise_returns:
            self.return_scale.fill_(self.log_returns.spread)
        self.effective_episodes = data.effective_episodes
        if self.source is not None:
            self.source.begin(self.return_scale)

    def _start_from(self, folder: str) -> None:
        base = load_policy(folder)
        try:
            self.actor.start_from(base)
        except UserError as error:
            raise UserError(f"{folder} does not fit the actor: {error}") from None
        self.average_actor.load_state_dict(self.actor.state_dict())
        self.started.fill_(True)

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        """Adam for each part, in the order of `parts`; all its parameters in one kernel."""
        parts = self.parts().values()
        return [torch.optim.Adam(p.module.parameters(), lr=p.learning_rate, betas=p.betas, fused=True) for p in parts]

    def on_fit_start(self) -> None:
        training.keep_freed_memory()

    def on_train_epoch_start(self) -> None:
        # each epoch depends on its own seed alone: a run can resume there
        self.clones = not bool(self.started)
        stream = f"agent{self.global_rank or ''}"
        self.generator = epoch_generator(self.seed, self.current_epoch, stream, self.device)
        self.update_index = self.current_epoch * self.options.updates_per_epoch
        self.logged: dict[str, list[Tensor]] = {}
        for phase in self.phases:
            phase.begin_epoch(self)

    def training_step(self, batch: Batch, batch_index: int) -> None:
        for k in range(len(batch["rewards"])):
            logs = self.update({name: column[k] for name, column in batch.items()})
            for name, value in logs.items():
                self.logged.setdefault(name, []).append(value.detach())
            self.update_index += 1

    def on_train_epoch_end(self) -> None:
        means = {name: torch.stack(values).mean() for name, values in self.logged.items()}
        logs = means | {"effective_episodes": torch.tensor(self.effective_episodes)}
        self.log_dict({f"train/{name}": value for name, value in logs.items()})

    def validation_step(self, batch: Batch, batch_index: int) -> None:
        action = self.average_actor.act(batch["observations"])
        logs = {"action_error": (action - batch["actions"]).square().mean()} | self.validation_logs(batch)
        self.log_dict({f"val/{name}": value for name, value in logs.items()}, batch_size=len(action))
