"""What offline actor-critic agents share: batches of data and imagination, the warm start, targets, the update loop."""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import lightning as L
import torch
from torch import Tensor, nn

from envtf_lit import training
from envtf_lit.agents.networks import StackedCritics
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.ring import ImaginedRing
from envtf_lit.agents.value_gradient import ValueGradient
from envtf_lit.data.loaders import TransitionData, epoch_generator
from envtf_lit.errors import UserError
from envtf_lit.imagination.options import ImaginationOptions, ValueGradientOptions
from envtf_lit.imagination.rollouts import Imagination, Rollouts
from envtf_lit.policy import TanhGaussianActor, load_policy

Batch = dict[str, Tensor]
TARGET_VALUE_RATE = 0.3  # share of the state value that enters its target at each update of the actor through the model


class OfflineAgent(L.LightningModule, ABC):
    """Actor, critics and their targets, updated several times per training step (manual optimisation).

    A batch holds (K, B, …) transitions for K gradient steps; there is no host synchronisation between them. With
    imagination, `1 - real_ratio` of each B rows is replaced by rows of the imagined ring, and in the last updates the
    actor follows the gradient of imagined returns (`ValueGradient`).

    Logged names are explained in docs/metrics.md.

    Args:
        observation_dim: S.
        action_dim: A.
        options: of the networks and of the optimisation; a plain dictionary when read from a checkpoint.
        action_low, action_high: (A,), None for [-1, 1].
        seed: of everything random.
        init_from: a published policy folder whose actor to start from. The warm start then fits the critics alone.
        freeze: parts of the actor that stay as they are, such as `net.2`.
    """

    log_alpha: nn.Parameter
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
        init_from: str | None = None,
        freeze: Sequence[str] = (),
    ) -> None:
        super().__init__()
        self.options = _policy_options(options)
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
        self.seed, self.init_from = seed, init_from
        self.actor = TanhGaussianActor(
            observation_dim, action_dim, hidden=self.options.hidden, action_low=action_low, action_high=action_high
        )
        self.critics = StackedCritics(
            observation_dim,
            action_dim,
            n=self.options.critics,
            hidden=self.options.hidden,
            layer_norm=self.options.layer_norm,
        )
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.average_actor = copy.deepcopy(self.actor).requires_grad_(False)
        training.freeze(self.actor, freeze)
        self.log_alpha = nn.Parameter(torch.tensor(self.options.initial_alpha).log())
        self.ring: ImaginedRing | None = None
        self.value_gradient: ValueGradient | None = None
        if self.options.imagination is not None:
            self.ring = ImaginedRing(observation_dim, action_dim, self.options.imagination.buffer_size)
            if self.options.imagination.value_gradient is not None:
                self.value_gradient = ValueGradient(observation_dim, self.options.imagination.value_gradient)
        self.imagination: Imagination | None = None
        self.first: Rollouts | None = None
        self.reward_std = 1.0
        self.register_buffer("return_scale", torch.ones(()))  # rewards are divided by it: see `normalise_returns`
        self.register_buffer("started", torch.tensor(False))  # the actor began from another, in a resumed run too

    def normalise_with(self, mean: Tensor, std: Tensor) -> None:
        """Sets the observation scale of every network."""
        networks: list[Any] = [self.actor, self.average_actor, self.critics, self.target_critics]
        if self.value_gradient is not None:
            networks += [self.value_gradient.value, self.value_gradient.target_value]
        for network in networks:
            network.observation_mean.copy_(mean)
            network.observation_std.copy_(std)

    def dream_with(self, imagination: Imagination, first: Rollouts, *, reward_std: float) -> None:
        """Gives the agent a world model, stored rollouts to begin with, and the unit of the penalty."""
        self.imagination, self.reward_std, self.first = imagination, reward_std, first

    # Lightning hooks

    def setup(self, stage: str) -> None:
        """Takes scales from the dataset, the actor's layers from `init_from`, and the first rollouts."""
        data: TransitionData = self.trainer.datamodule  # pyright: ignore[reportAttributeAccessIssue]
        self.normalise_with(*data.dataset.observation_scale())
        if self.init_from is not None:
            self._start_from(self.init_from)
        returns = data.transitions.columns["returns"]
        self.return_variance = returns.var(correction=0).clamp(min=1e-12).item()
        if self.options.normalise_returns:
            self.return_scale.fill_(self.return_variance**0.5)
        if self.first is not None:
            self.remember(self.first)

    def _start_from(self, folder: str) -> None:
        base = load_policy(folder)
        try:
            self.actor.start_from(base)
        except UserError as error:
            raise UserError(f"{folder} does not fit the actor: {error}") from None
        self.average_actor.load_state_dict(self.actor.state_dict())
        self.started.fill_(True)

    def on_train_epoch_start(self) -> None:
        self.clones = not bool(self.started)
        stream = f"agent{self.global_rank or ''}"
        self.generator = epoch_generator(self.seed, self.current_epoch, stream, self.device)
        self.update_index = self.current_epoch * self.options.updates_per_epoch
        self.logged: dict[str, list[Tensor]] = {}
        if self.value_gradient is not None:  # each epoch depends on its own seed alone: a run can resume there
            self.value_gradient.restart()

    def training_step(self, batch: Batch, batch_index: int) -> None:
        for k in range(len(batch["rewards"])):
            logs = self.update({name: column[k] for name, column in batch.items()})
            for name, value in logs.items():
                self.logged.setdefault(name, []).append(value.detach())
            self.update_index += 1

    def on_train_epoch_end(self) -> None:
        self.log_dict({f"train/{name}": torch.stack(values).mean() for name, values in self.logged.items()})
        if self.imagination is not None and self.imagination.options.selection_episodes > 0:
            self.log("val/imagined_return", self.imagination.imagined_return(self.average_actor))

    def validation_step(self, batch: Batch, batch_index: int) -> None:
        q = self.return_scale * self.critics(batch["observations"], batch["actions"]).min(0).values
        action = self.average_actor.act(batch["observations"])
        logs = dict(
            q_data=q.mean(),
            return_error=(q - batch["returns"]).square().mean() / self.return_variance,
            action_error=(action - batch["actions"]).square().mean(),
        )
        self.log_dict({f"val/{name}": value for name, value in logs.items()}, batch_size=len(q))

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        o = self.options
        actor = torch.optim.Adam(self.actor.parameters(), lr=o.actor_learning_rate)
        critics = torch.optim.Adam(self.critics.parameters(), lr=o.critic_learning_rate)
        alpha = torch.optim.Adam([self.log_alpha], lr=o.actor_learning_rate)
        if self.value_gradient is None:
            return [actor, critics, alpha]
        value, options = self.value_gradient.value, self.value_gradient.options
        return [
            actor,
            critics,
            alpha,
            torch.optim.Adam(self.actor.parameters(), lr=options.learning_rate, betas=(0.7, 0.95)),  # SHAC's
            torch.optim.Adam(value.parameters(), lr=options.value_learning_rate),
        ]

    # One gradient step

    def update(self, batch: Batch) -> dict[str, Tensor]:
        """One gradient step of every part; returns detached scalars to log."""
        batch = batch | {name: batch[name] / self.return_scale for name in ("rewards", "returns")}
        batch["real"] = torch.ones_like(batch["rewards"])
        if self.update_index < self.options.warm_start:
            return self.warm_up(batch)
        if (gradient := self.value_gradient) is not None:
            climbed = self.update_index - (self.options.updates - gradient.options.updates)
            if climbed >= 0:
                return self.climb(batch, gradient, climbed)
        batch = self.mix(batch)
        actor_optimizer, critic_optimizer, alpha_optimizer, *_ = self._optimizers()
        critic_loss, logs = self.critic_loss(batch, self.generator)
        _descend(self, critic_optimizer, critic_loss)
        self.critics.requires_grad_(False)
        actor_loss, actor_logs = self.actor_loss(batch, self.generator)
        _descend(self, actor_optimizer, actor_loss)
        self.critics.requires_grad_(True)
        _descend(self, alpha_optimizer, self.temperature_loss(actor_logs["entropy"]))
        self.follow()
        return logs | actor_logs | dict(alpha=self.log_alpha.exp())

    def warm_up(self, batch: Batch) -> dict[str, Tensor]:
        """Critics regress on Monte-Carlo returns of the log; the actor clones it, unless it began from `init_from`."""
        actor_optimizer, critic_optimizer, *others = self._optimizers()
        q = self.critics(batch["observations"], batch["actions"])
        critic_loss = 0.5 * (q - batch["returns"]).square().mean(1).sum()
        _descend(self, critic_optimizer, critic_loss)
        clone_loss = self.clone_loss(batch)
        if self.clones:
            _descend(self, actor_optimizer, clone_loss)
        if self.value_gradient is not None:
            _descend(self, others[-1], self.value_gradient.value_loss(batch["observations"], batch["returns"]))
        if self.update_index == self.options.warm_start - 1:
            self.target_critics.load_state_dict(self.critics.state_dict())
            self.average_actor.load_state_dict(self.actor.state_dict())
            if self.value_gradient is not None:
                self.value_gradient.target_value.load_state_dict(self.value_gradient.value.state_dict())
        return dict(warm_critic_loss=critic_loss, clone_loss=clone_loss, q_data=q.mean())

    def clone_loss(self, batch: Batch) -> Tensor:
        """`-log pi(a|s)`, mean over the real rows."""
        log_density = self.actor.log_prob(batch["observations"], batch["actions"])
        return -(batch["real"] * log_density).sum() / batch["real"].sum()

    def climb(self, batch: Batch, gradient: ValueGradient, done: int) -> dict[str, Tensor]:
        """One update of the actor along the gradient of imagined returns, kept near the real rows' actions.

        It begins at the averaged actor. The state value then learns from the same paths. `done` counts the updates
        before this one.
        """
        assert self.imagination is not None
        options = gradient.options
        if done == 0:
            self.actor.load_state_dict(self.average_actor.state_dict())
        *_, actor_optimizer, value_optimizer = self._optimizers()
        actor_optimizer.param_groups[0]["lr"] = options.learning_rate * gradient.rate(done / options.updates)
        with torch.autocast(self.device.type, enabled=False):  # errors of bf16 would add up along the path
            paths = gradient.paths(self.actor, self.imagination, self.return_scale, self.generator)
            gradient.value.requires_grad_(False)
            imagined = gradient.imagined_return(paths, self.options.discount).mean()
            clone_loss = self.clone_loss(batch)
            _descend(self, actor_optimizer, options.clone_weight * clone_loss - imagined, clip=1.0)
            gradient.value.requires_grad_(True)
            for observations, targets in gradient.lessons(paths, self.options.discount, self.generator):
                value_loss = gradient.value_loss(observations, targets)
                _descend(self, value_optimizer, value_loss)
        _follow(gradient.target_value, gradient.value, TARGET_VALUE_RATE)
        _follow(self.average_actor, self.actor, options.actor_average)
        return dict(imagined_value=imagined * self.return_scale, value_loss=value_loss, clone_loss=clone_loss)

    def _optimizers(self) -> list[Any]:
        """As `configure_optimizers` lists them; actor's, critics' and alpha's at the current update's rates."""
        optimizers: list[Any] = self.optimizers()  # pyright: ignore[reportAssignmentType]
        for optimizer, rate in zip(optimizers, self._rates(), strict=False):
            optimizer.param_groups[0]["lr"] = rate
        return optimizers

    def _rates(self) -> tuple[float, float, float]:
        """Learning rates of actor, critics and alpha."""
        o, done = self.options, self.update_index - self.options.warm_start
        if done < 0:
            return o.warm_start_learning_rate, o.warm_start_learning_rate, 0.0
        actor = o.actor_learning_rate
        if o.actor_schedule == "cosine":
            actor *= 0.5 * (1.0 + math.cos(math.pi * done / max(1, o.updates - o.warm_start)))
        return actor, o.critic_learning_rate, o.actor_learning_rate

    def mix(self, batch: Batch) -> Batch:
        """Replaces the last rows of a real batch by imagined ones; `real` (B,) marks what is real."""
        imagination = self.options.imagination
        if imagination is None or self.ring is None:
            return batch
        if self.imagination is not None and self._refresh_now(imagination):
            self.remember(self.imagination.rollouts(self.actor, self.generator))
        kept = round(imagination.real_ratio * len(batch["real"]))
        imagined = self.ring.draw(len(batch["real"]) - kept, self.generator)
        imagined["real"] = torch.zeros_like(imagined["rewards"])
        return {name: torch.cat([batch[name][:kept], column]) for name, column in imagined.items()}

    def remember(self, rollouts: Rollouts) -> None:
        """Puts rollouts into the ring, rewards less the penalty `weight * std(r) * u`."""
        imagination = self.options.imagination
        assert self.ring is not None and imagination is not None
        rewards = rollouts.rewards - imagination.penalty * self.reward_std * rollouts.uncertainty
        rewards = rewards / self.return_scale
        if imagination.multi_step:
            total, end, weight = rollouts.returns(rewards, self.options.discount)
        else:
            weight = self.options.discount * (~rollouts.terminated).float()
            total, end = rewards, rollouts.next_observations
        kept = rollouts.step < imagination.horizon  # what comes after is there for its rewards
        columns = dict(
            observations=rollouts.observations,
            actions=rollouts.actions,
            rewards=total,
            next_observations=end,
            discounts=weight,
        )
        self.ring.add({name: column[kept] for name, column in columns.items()})

    def _refresh_now(self, imagination: ImaginationOptions) -> bool:
        every = imagination.refresh_every
        return every > 0 and (self.update_index - self.options.warm_start) % every == 0

    def follow(self) -> None:
        """Targets move towards the critics, the averaged actor towards the actor."""
        _follow(self.target_critics, self.critics, self.options.target_rate)
        _follow(self.average_actor, self.actor, self.options.actor_average)

    # What an algorithm defines: losses, and detached scalars to log

    @abstractmethod
    def critic_loss(self, batch: Batch, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Of a mixed batch, reaching the critics alone."""

    @abstractmethod
    def actor_loss(self, batch: Batch, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Of a mixed batch; logs `entropy`."""

    @abstractmethod
    def temperature_loss(self, entropy: Tensor) -> Tensor:
        """Of the actor's mean entropy, reaching `log_alpha` alone."""


@torch.no_grad()
def _follow(follower: nn.Module, leader: nn.Module, rate: float) -> None:
    for slow, fast in zip(follower.parameters(), leader.parameters(), strict=True):
        slow.lerp_(fast, rate)


def _descend(module: L.LightningModule, optimizer: Any, loss: Tensor, clip: float | None = None) -> None:
    optimizer.zero_grad(set_to_none=True)
    module.manual_backward(loss)
    if clip is not None:
        module.clip_gradients(optimizer, gradient_clip_val=clip, gradient_clip_algorithm="norm")
    optimizer.step()


def _policy_options(options: PolicyOptions | dict[str, Any] | None) -> PolicyOptions:
    """Options as given, or rebuilt from the plain dictionary of a checkpoint."""
    if options is None:
        return PolicyOptions()
    if isinstance(options, PolicyOptions):
        return options
    imagination = options.get("imagination")
    if isinstance(imagination, dict):
        climbing = imagination.get("value_gradient")
        climbing = ValueGradientOptions(**climbing) if isinstance(climbing, dict) else climbing
        imagination = ImaginationOptions(**{**imagination, "value_gradient": climbing})
    return PolicyOptions(**{**options, "hidden": tuple(options["hidden"]), "imagination": imagination})
