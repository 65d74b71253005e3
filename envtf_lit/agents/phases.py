"""Stretches of an agent's training, each with its own number of updates, and the parts that learn in them."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from envtf_lit.agents.agent import Agent

Batch = dict[str, Tensor]
Logs = dict[str, Tensor]


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


@torch.no_grad()
def follow(follower: nn.Module, leader: nn.Module, rate: float) -> None:
    """Moves every parameter by this share of the way to the leader's."""
    move = torch._foreach_lerp_  # pyright: ignore[reportPrivateImportUsage]
    move(list(follower.parameters()), list(leader.parameters()), rate)
