"""The warm start: before an algorithm's own losses, values fit the log's returns and the actor clones its actions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from envtf_lit.agents.agent import Agent, Batch, Logs, Phase

if TYPE_CHECKING:
    from envtf_lit.agents.sac import SAC

LEARNING_RATE = 0.001  # Adam's, of all that learns here


class WarmStart(Phase):
    """Critics regress on Monte-Carlo returns of the log; the actor clones it, unless it began from another."""

    def __init__(self, updates: int) -> None:
        self.updates = updates

    def update(self, agent: Agent, batch: Batch, done: int) -> Logs:
        sac: SAC = agent  # pyright: ignore[reportAssignmentType]
        critic_loss, logs = sac.value_loss(batch)
        sac.descend("critics", critic_loss, rate=LEARNING_RATE)
        clone_loss = sac.clone_loss(batch)
        if sac.clones:
            sac.descend("actor", clone_loss, rate=LEARNING_RATE)
        if done == self.updates - 1:
            sac.target_critics.load_state_dict(sac.critics.state_dict())
            sac.average_actor.load_state_dict(sac.actor.state_dict())
        return logs | dict(clone_loss=clone_loss)
