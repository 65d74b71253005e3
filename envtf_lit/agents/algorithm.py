"""What an algorithm defines: its options, networks, parts, losses and phases, and the actor that it trains."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any, ClassVar

import lightning as L
import torch
from torch import Tensor

from envtf_lit import training
from envtf_lit.actors import Actor, TanhGaussianActor
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.phases import Batch, Logs, Losses, Part, Phase, follow
from envtf_lit.agents.scales import LogReturns
from envtf_lit.divergence import Bound
from envtf_lit.errors import UserError
from envtf_lit.imagination.buffer import ImaginedBatches
from envtf_lit.options.schema import build


class Algorithm(L.LightningModule, ABC):
    """An actor and what it learns from; `agent.Agent` adds the loop of its training.

    Rewards and returns are divided by `return_scale`. Logged names are explained in docs/metrics.md.

    Attributes:
        Options: the algorithm's own dataclass of options.
        label: its name in figures and tables.
        imagines: whether it learns from a world model, too.
        watches: whether it watches held-out episodes, which it then doesn't learn from, whatever the task.
        cures: what helps most against divergence, by the logged name; see `divergence.check_epoch`.
        actor_kind: of its policy.
        log_returns: what they are like in the dataset.

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
    watches: ClassVar[bool] = False
    cures: ClassVar[Mapping[str, str]] = {"": "lower actor_learning_rate, or look for outliers with `envtf data check`"}
    actor_kind: ClassVar[type[Actor]] = TanhGaussianActor

    options: PolicyOptions
    actor: Actor
    return_scale: Tensor
    started: Tensor
    generator: torch.Generator  # of an epoch's draws
    clones: bool  # whether the warm start clones the log

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
        self.log_returns = LogReturns()
        self.register_buffer("return_scale", torch.ones(()))  # rewards are divided by it: see `normalise_returns`
        self.register_buffer("started", torch.tensor(False))  # the actor began from another, in a resumed run too

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

    @property
    def bounds(self) -> dict[str, Bound]:
        """What no logged values of a sound training are above; see `divergence.check_epoch`."""
        return self.log_returns.bounds(float(self.return_scale))

    def clone_loss(self, batch: Batch) -> Tensor:
        """The actor's distance from the recorded actions (`Actor.clone_error`), mean over the real rows."""
        error = self.actor.clone_error(batch["observations"], batch["actions"])
        return (batch["real"] * error).sum() / batch["real"].sum()

    def validation_logs(self, batch: Batch) -> Logs:
        """Further scalars to log of held-out rows."""
        return {}

    def records(self) -> dict[str, list[dict[str, Any]]]:
        """Tables to publish beside the policy, by name; each row's columns are alike."""
        return {}
