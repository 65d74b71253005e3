"""What every offline agent shares: the loop of updates, phases, optimisers by name, the averaged actor, resuming."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import lightning as L
import torch
from torch import Tensor, nn

from envtf_lit import training
from envtf_lit.actors import Actor, TanhGaussianActor
from envtf_lit.agents.divergence import check_means
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.data.datamodules import TransitionData
from envtf_lit.data.loaders import epoch_generator
from envtf_lit.errors import UserError
from envtf_lit.imagination.buffer import ImaginedBatches
from envtf_lit.options.schema import build
from envtf_lit.policy import load_policy

Batch = dict[str, Tensor]
Logs = dict[str, Tensor]
EQUAL = 1e-3  # of a typical return, up to which a spread of returns is rounding, or as good as none


@dataclass(frozen=True)
class Part:
    """What one optimiser trains.

    Attributes:
        module: whose parameters.
        learning_rate: Adam's, unless a phase sets another.
        betas: Adam's.
    """

    module: nn.Module
    learning_rate: float
    betas: tuple[float, float] = (0.9, 0.999)


class Phase:
    """A stretch of an agent's training in which every update does the same.

    Attributes:
        updates: how many.
    """

    updates: int

    def update(self, agent: "Agent", batch: Batch, done: int) -> Logs:
        """One gradient step of every part that learns in this phase, after `done` others; returns what to log."""
        raise NotImplementedError

    def begin_epoch(self, agent: "Agent") -> None:
        """Called at the start of each epoch: what it carries on from update to update must not outlive one."""


class Losses(Phase):
    """The algorithm's own losses, on batches of real rows or of real and imagined ones.

    Args:
        updates: how many.
        scheduled: updates over which learning rates fall; None for as many.
    """

    def __init__(self, updates: int, scheduled: int | None = None) -> None:
        self.updates, self.scheduled = updates, scheduled or updates

    def update(self, agent: "Agent", batch: Batch, done: int) -> Logs:
        logs: Logs = {}
        if agent.source is not None:
            batch = agent.source.mix(batch, done, agent.actor, agent.generator)
            logs |= {} if agent.source.cut_share is None else {"cut_share": agent.source.cut_share}
        for part, loss, found in agent.losses(batch):
            agent.descend(part, loss, rate=agent.rate(part, done / self.scheduled))
            logs |= found
        agent.update_targets()
        return logs


class Agent(L.LightningModule, ABC):
    """An actor, what it learns from, and how they are updated, several times per training step.

    A batch holds (K, B, …) transitions for K gradient steps; there is no host synchronisation between them. Rewards
    and returns are divided by `return_scale`. Logged names are explained in docs/metrics.md.

    Attributes:
        Options: the algorithm's own dataclass of options.
        label: its name in figures and tables.
        imagines: whether it learns from a world model, too.
        cures: what helps most against divergence, by the logged name; see `divergence.check_means`.
        actor_kind: of its policy.

    Args:
        observation_dim: S.
        action_dim: A.
        options: of the networks and of the optimisation; a plain dictionary when read from a checkpoint.
        action_low, action_high: (A,), None for [-1, 1].
        seed: of everything random.
        source: of imagined rows, for algorithms that imagine.
        init_from: a published policy folder whose actor to start from. The actor then does not clone the log first.
        freeze: parts of the actor that stay as they are, such as `net.2`.

    Raises:
        UserError: the algorithm imagines and has no source, or the other way round.
    """

    Options: ClassVar[type[PolicyOptions]]
    label: ClassVar[str]
    imagines: ClassVar[bool] = False
    cures: ClassVar[Mapping[str, str]] = {"": "lower actor_learning_rate, or look for outliers with `envtf data check`"}
    actor_kind: ClassVar[type[Actor]] = TanhGaussianActor

    options: PolicyOptions
    actor: Actor
    return_scale: Tensor
    started: Tensor

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        options: PolicyOptions | dict[str, Any] | None = None,
        action_low: list[float] | None = None,
        action_high: list[float] | None = None,
        seed: int = 0,
        source: ImaginedBatches | None = None,
        init_from: str | None = None,
        freeze: Sequence[str] = (),
    ) -> None:
        super().__init__()
        if self.imagines and source is None:
            raise UserError(
                f"{self.label} imagines and has no source of imagined rows: give it one, source=ImaginedBatches(…)."
            )
        if source is not None and not self.imagines:
            raise UserError(
                f"{self.label} learns from data alone and is given a source of imagined rows: leave it out."
            )
        if not isinstance(options, dict):
            options = asdict(options or self.Options())
        self.options = build(self.Options, options, "")
        self.save_hyperparameters(
            dict(
                observation_dim=observation_dim,
                action_dim=action_dim,
                options=asdict(self.options) | {"hidden": list(self.options.hidden)},
                action_low=action_low,
                action_high=action_high,
                seed=seed,
                freeze=list(freeze),
            )
        )
        self.automatic_optimization = False
        self.observation_dim, self.action_dim = observation_dim, action_dim
        self.seed, self.source, self.init_from = seed, source, init_from
        self.actor = self.actor_kind(
            observation_dim, action_dim, hidden=self.options.hidden, action_low=action_low, action_high=action_high
        )
        self.build_networks()
        self.average_actor = copy.deepcopy(self.actor).requires_grad_(False)
        training.freeze(self.actor, freeze)
        self.phases = self.build_phases()
        # of the log's rows, in its own rewards, their returns' mean (see `loaders.Transitions`) and standard deviation
        self.typical_return, self.return_spread = 0.0, 1.0
        self.largest_return = float("inf")  # likewise, that any policy can have: max |r| / (1 - discount)
        self.register_buffer("return_scale", torch.ones(()))  # rewards are divided by it: see `normalise_returns`
        self.register_buffer("started", torch.tensor(False))  # the actor began from another, in a resumed run too

    # What an algorithm defines

    def build_networks(self) -> None:
        """Makes the modules beside the actor, as attributes; those with an observation scale are given the data's."""

    def build_phases(self) -> list[Phase]:
        """The stretches of the training, in order; together they last `options.updates`."""
        return [Losses(self.options.updates)]

    @abstractmethod
    def parts(self) -> dict[str, Part]:
        """What learns, by name; each has an optimiser of its own."""

    @abstractmethod
    def losses(self, batch: Batch) -> Iterator[tuple[str, Tensor, Logs]]:
        """(part, loss, what to log), in the order in which they descend; each is computed after the one before did."""

    def warm_start_losses(self, batch: Batch) -> Iterator[tuple[str, Tensor, Logs]]:
        """As `losses`, before them: what the log alone teaches. An actor that began from another does not clone it."""
        if self.clones:
            loss = self.clone_loss(batch)
            yield "actor", loss, dict(clone_loss=loss)

    def complete_returns(self, batch: Batch) -> Batch:
        """A real batch whose `returns` count what lies beyond truncations, for values that learn in the warm start."""
        return batch

    def end_warm_start(self) -> None:
        """What follows slowly catches up."""
        self.average_actor.load_state_dict(self.actor.state_dict())

    def rate(self, part: str, progress: float) -> float:
        """A part's learning rate after this share of the `Losses` phase."""
        return self.parts()[part].learning_rate

    def update_targets(self) -> None:
        """After each update of the losses: the averaged actor follows the actor."""
        follow(self.average_actor, self.actor, self.options.actor_average)

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

    def update(self, batch: Batch) -> Logs:
        """One update in the phase that is under way; returns detached scalars to log."""
        scaled = {name: batch[name] / self.return_scale for name in ("rewards", "returns")}
        batch = batch | scaled | {"real": torch.ones_like(batch["rewards"])}
        done = self.update_index
        for phase in self.phases:
            if done < phase.updates:
                return phase.update(self, batch, done)
            done -= phase.updates
        last = next(phase for phase in reversed(self.phases) if phase.updates > 0)
        return last.update(self, batch, last.updates - 1)  # asked for more than planned

    def clone_loss(self, batch: Batch) -> Tensor:
        """The actor's distance from the recorded actions (`Actor.clone_error`), mean over the real rows."""
        error = self.actor.clone_error(batch["observations"], batch["actions"])
        return (batch["real"] * error).sum() / batch["real"].sum()

    # Lightning hooks

    def setup(self, stage: str) -> None:
        """Takes scales from the dataset, the actor's layers from `init_from`, and the stored rollouts."""
        data: TransitionData = self.trainer.datamodule  # pyright: ignore[reportAttributeAccessIssue]
        self.normalise_with(*data.dataset.observation_scale())
        if self.init_from is not None:
            self._start_from(self.init_from)
        returns = data.transitions.complete_returns()
        spread, self.typical_return = float(returns.std(correction=0)), data.transitions.typical_return
        if spread <= EQUAL * abs(self.typical_return):  # all are alike: no scale but their size
            spread = abs(self.typical_return) or 1.0
        self.return_spread = spread
        if self.options.normalise_returns:
            self.return_scale.fill_(spread)
        self.effective_episodes = data.effective_episodes
        self.largest_return = float(abs(data.dataset.rewards).max()) / (1.0 - self.options.discount)
        if self.source is not None:
            self.source.begin(self.return_scale)

    def normalise_with(self, mean: Tensor, std: Tensor) -> None:
        """Sets the observation scale (S,) of every network that has one."""
        for module in self.modules():
            if isinstance(getattr(module, "observation_mean", None), Tensor):
                network: Any = module
                network.observation_mean.copy_(mean)
                network.observation_std.copy_(std)

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
        largest = self.largest_return / float(self.return_scale)
        check_means(means, largest, self.label, self.current_epoch + 1, self.cures)
        logs = means | {"effective_episodes": torch.tensor(self.effective_episodes)}
        self.log_dict({f"train/{name}": value for name, value in logs.items()})

    def validation_step(self, batch: Batch, batch_index: int) -> None:
        action = self.average_actor.act(batch["observations"])
        logs = {"action_error": (action - batch["actions"]).square().mean()} | self.validation_logs(batch)
        self.log_dict({f"val/{name}": value for name, value in logs.items()}, batch_size=len(action))

    def validation_logs(self, batch: Batch) -> Logs:
        """Further scalars to log of held-out rows."""
        return {}


@torch.no_grad()
def follow(follower: nn.Module, leader: nn.Module, rate: float) -> None:
    """Moves every parameter by this share of the way to the leader's."""
    move = torch._foreach_lerp_  # pyright: ignore[reportPrivateImportUsage]
    move(list(follower.parameters()), list(leader.parameters()), rate)
