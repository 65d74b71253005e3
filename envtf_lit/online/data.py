"""Batches of a policy's own experience, collected as it learns, and of a log's rows beside it."""

from collections.abc import Callable, Iterator
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from envtf_lit.actors import Actor, DeterministicActor
from envtf_lit.agents.actor_critic import ActorCritic
from envtf_lit.agents.warm_start import WarmStart
from envtf_lit.data.datamodules import TransitionData
from envtf_lit.data.dataset import OfflineDataset, starts_from_ends
from envtf_lit.data.loaders import DrawSampler, epoch_generator
from envtf_lit.data.options import UPDATES_PER_STEP
from envtf_lit.data.sources.files import load_dataset
from envtf_lit.errors import UserError
from envtf_lit.online.interaction import Interaction, Rows
from envtf_lit.online.match import check_match, environment_of
from envtf_lit.online.replay import Replay
from envtf_lit.options.numbers import Count, Natural, Positive, Share
from envtf_lit.policy import RandomPolicy
from envtf_lit.robots.environments import action_limits, robot_in

EXPLORATION = 0.1  # deviation of the noise on a deterministic actor's actions, in half ranges (Fujimoto et al. 2018)
Batch = dict[str, Tensor]


class OnlineData(TransitionData):
    """Transitions for an agent that learns, or goes on learning, in an environment.

    Before each batch the agent's actor acts, with noise, and what it lives through enters a replay buffer on the
    device. A share of each batch is of the log: half, as in RLPD (Ball et al. 2023, section 4.1, symmetric sampling).
    Nobody acts while an agent warms up on the log. What is drawn depends on seed and epoch alone, and a checkpoint
    holds the buffer and where the environments stand, so that a run goes on to the same bits. A run on a log alone
    can go on here, too, with its critics.

    Attributes:
        robot: in whose environment it acts.
        interaction: the environments.
        replay: what was lived through; from `setup` on.

    Args:
        path: dataset file of the log; None has none, and the first steps, which are random, stand in for it where
            scales are taken.
        environment: a robot, a task, or the id of a Gymnasium environment; None takes that of the log.
        environments: copies of it that step together.
        updates_per_env_step: gradient steps for each step of an environment.
        log_share: of the log's rows in each batch.
        first_steps: of the environments before the first gradient step on experience; with a log by the actor, without
            one by uniform random actions.
        replay_rows: newest transitions that are kept.
        evaluation_episodes: of the averaged actor, before the first epoch and after each; 0 for none.
        seed: of all draws, actions and episodes.
        options: see `TransitionData`.

    Raises:
        UserError: no environment is named, it is none for these policies, or its dimensions are not the log's.
    """

    replay: Replay

    def __init__(
        self,
        path: str | None = None,
        environment: str | None = None,
        environments: Count = 1,
        updates_per_env_step: Positive = 1.0,
        log_share: Share = 0.5,
        first_steps: Count = 1_000,
        replay_rows: Count = 1_000_000,
        evaluation_episodes: Natural = 10,
        seed: int = 0,
        **options: Any,
    ) -> None:
        self.log = None if path is None else load_dataset(path)
        self.robot = robot_in(environment or environment_of(self.log))
        self.limits = action_limits(self.robot)
        if self.log is not None:
            check_match(self.log, self.robot, self.limits)
        self.updates_per_env_step, self.log_share = updates_per_env_step, log_share
        self.first_steps, self.replay_rows, self.evaluation_episodes = first_steps, replay_rows, evaluation_episodes
        self.interaction = Interaction(self.robot, environments, seed)
        self.began: int | None = None  # the agent's updates before the first one on experience, once that has come
        self.first_rows = [] if self.log is not None else self._random_steps(seed)
        super().__init__(path or "", seed=seed, **options)
        self.action_low, self.action_high = (limit.tolist() for limit in self.limits)

    def read(self, path: str) -> OfflineDataset:
        """The log, or the first steps in its place."""
        return self.log or as_dataset(joined(self.first_rows), self.interaction.environments, self.limits)

    def lived(self) -> OfflineDataset:
        """What the replay holds, as a dataset."""
        return as_dataset(self.replay.state_dict(), self.interaction.environments, self.limits)

    @property
    def agent(self) -> ActorCritic:
        """Who acts and learns."""
        return cast(ActorCritic, cast(Any, self.trainer).lightning_module)

    @property
    def warm_updates(self) -> int:
        """The agent's first updates, on the log alone."""
        return sum(phase.updates for phase in self.agent.phases if isinstance(phase, WarmStart))

    def setup(self, stage: str) -> None:
        """Makes the buffer where the trainer works; called by Lightning.

        Raises:
            UserError: the agent is not of a kind that learns online, or shall warm up without a log; there are several
                processes; or nothing is trained.
        """
        trainer: Any = self.trainer
        if stage != "fit":
            raise UserError("`envtf agent validate` looks at a log's rows: leave out --data.source online.")
        if not isinstance(self.agent, ActorCritic):
            raise UserError(
                f"{self.agent.label} imitates a log and learns nothing from rewards of its own: choose an algorithm "
                "with critics, such as --model.algorithm sac."
            )
        if self.log is None and self.warm_updates:
            raise UserError(
                f"model.options.warm_start is {self.agent.options.warm_start:g}, and there is no log to warm up on: "
                "give --model.options.warm_start 0, or a log with --data.path."
            )
        if trainer.world_size > 1:
            raise UserError(
                f"Online learning runs in one process, and these are {trainer.world_size}: give --trainer.devices 1."
            )
        trainer.limit_val_batches = 0  # what was learned shows in the environment
        self.replay = Replay(self.interaction.environments, self.replay_rows, trainer.strategy.root_device)
        for rows in self.first_rows:
            self.replay.add(rows)

    def train_dataloader(self) -> "Batches":  # pyright: ignore[reportIncompatibleMethodOverride]
        """Batches (UPDATES_PER_STEP, batch_size, …): the log's share of their rows first, then those of the replay."""
        return Batches(self._batches, self.steps_per_epoch)

    def val_dataloader(self) -> list[Batch]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Nothing: see `Evaluation`."""
        return []

    def state_dict(self) -> dict[str, Any]:
        """Part of checkpoints."""
        return dict(began=self.began, interaction=self.interaction.state_dict(), replay=self.replay.state_dict())

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """As of a checkpoint; called by Lightning after `setup`."""
        self.began = state_dict["began"]
        self.interaction.load_state_dict(state_dict["interaction"])
        self.replay.load_state_dict(state_dict["replay"])

    def _batches(self) -> Iterator[Batch]:
        """Those of the epoch under way."""
        epoch = cast(Any, self.trainer).current_epoch
        acting, drawing = (epoch_generator(self.seed, epoch, what, self.replay.device) for what in ("acting", "replay"))
        act = exploring(self.agent.actor, acting)
        drawn = DrawSampler(
            len(self.transitions),
            (UPDATES_PER_STEP, self.batch_size),
            self.steps_per_epoch,
            seed=self.seed,
            weights=self.weights,
        )
        drawn.set_epoch(epoch)
        updates = UPDATES_PER_STEP * self.steps_per_epoch * epoch
        for rows in drawn:
            if updates < self.warm_updates:
                yield self.transitions[rows]
            else:
                self.began = updates if self.began is None else self.began
                due = self.first_steps + (updates + UPDATES_PER_STEP - self.began) / self.updates_per_env_step
                while self.interaction.steps < due:
                    self.replay.add(self.interaction.step(act))
                yield self._mixed(rows, drawing)
            updates += UPDATES_PER_STEP

    def _mixed(self, rows: Tensor, generator: torch.Generator) -> Batch:
        """The log's share of a draw (K, B) of its rows, and what was lived through behind them."""
        updates, size = rows.shape
        logged = 0 if self.log is None else round(self.log_share * size)
        lived = self.replay.draw(updates * (size - logged), generator, discount=self.discount, n_step=self.n_step)
        lived = {name: column.unflatten(0, (updates, size - logged)) for name, column in lived.items()}
        if logged == 0:
            return lived
        log = self.transitions[rows[:, :logged]]
        return {name: torch.cat([log[name], column], 1) for name, column in lived.items()}

    def _random_steps(self, seed: int) -> list[Rows]:
        policy = RandomPolicy(*(torch.from_numpy(limit) for limit in self.limits))
        generator = epoch_generator(seed, 0, "first steps")
        rows = list[Rows]()
        while self.interaction.steps < self.first_steps:
            rows.append(self.interaction.step(lambda observation: policy.act(observation, generator=generator)))
        return rows


class Batches:
    """So many batches, made anew whenever they are gone through."""

    def __init__(self, make: Callable[[], Iterator[Batch]], count: int) -> None:
        self.make, self.count = make, count

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[Batch]:
        return self.make()


def exploring(actor: Actor, generator: torch.Generator) -> Callable[[Tensor], Tensor]:
    """An actor's sampled actions, or of a deterministic one with Gaussian noise, on the CPU.

    Args:
        actor: on any device.
        generator: on the same.
    """

    def act(observation: Tensor) -> Tensor:
        action = actor.act(observation.to(generator.device), deterministic=False, generator=generator)
        if isinstance(actor, DeterministicActor):
            noise = torch.randn(action.shape, generator=generator, device=action.device)
            action = action + EXPLORATION * 0.5 * (actor.action_high - actor.action_low) * noise
            action = torch.minimum(torch.maximum(action, actor.action_low), actor.action_high)
        return action.cpu()

    return act


def joined(steps: list[Rows]) -> Rows:
    """Steps of environments, as `Interaction.step` returns them, one after another in whole columns."""
    return {name: torch.cat([rows[name] for rows in steps]) for name in steps[0]}


def as_dataset(columns: Rows, environments: int, limits: tuple[np.ndarray, np.ndarray]) -> OfflineDataset:
    """Transitions of environments that stepped together as a dataset; each one's last episode is cut.

    Args:
        columns: (T * E, …) in the order of steps, as `Replay.state_dict` has them.
        environments: E.
        limits: of the actions.
    """
    steps = len(columns["rewards"]) // environments
    found: dict[str, Any] = {  # one environment after another
        name: column.unflatten(0, (steps, environments)).transpose(0, 1).flatten(0, 1).numpy().copy()
        for name, column in columns.items()
    }
    last = slice(steps - 1, None, steps)
    found["truncated"][last] |= ~found["terminated"][last]
    starts = starts_from_ends(found["terminated"] | found["truncated"])
    return OfflineDataset(**found, episode_starts=starts, action_low=limits[0], action_high=limits[1])
