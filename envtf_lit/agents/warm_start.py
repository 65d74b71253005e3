"""The warm start: before an algorithm's own losses, values fit the log's returns and the actor clones its actions."""

from envtf_lit.agents.agent import Agent
from envtf_lit.agents.phases import Batch, Logs, Phase

LEARNING_RATE = 0.001  # Adam's, of all that learns here


class WarmStart(Phase):
    """An agent's `warm_start_losses`, on real rows; its `end_warm_start` follows the last update."""

    def __init__(self, updates: int) -> None:
        self.updates = updates

    def update(self, agent: Agent, batch: Batch, done: int) -> Logs:
        logs: Logs = {}
        batch = agent.complete_returns(batch)
        for part, loss, found in agent.warm_start_losses(batch):
            agent.descend(part, loss, rate=self.rate(done))
            logs |= found
        if done == self.updates - 1:
            self.finish(agent)
        return logs

    def rate(self, done: int) -> float:
        """The learning rate after so many updates."""
        return LEARNING_RATE

    def finish(self, agent: Agent) -> None:
        """After the last update."""
        agent.end_warm_start()
