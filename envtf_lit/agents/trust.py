"""Trust: how far an actor may leave what its log supports, a constraint on its likelihood of held-out actions."""

import copy
import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from envtf_lit.actors import Actor
from envtf_lit.agents.agent import Agent
from envtf_lit.agents.phases import Batch, Logs
from envtf_lit.agents.warm_start import LEARNING_RATE, WarmStart
from envtf_lit.data.loaders import DrawnRows, epoch_generator

CHECK_EVERY = 250  # updates of the warm start between two looks at held-out rows
CHECKED = 8_192  # rows of each look
ROWS = 512  # likewise, at each update of the dual variable
FIRST, LEAST, MOST = 0.05, 1e-3, 100.0  # the dual variable at the start, and between which it stays
RATE = 0.3  # of its logarithm's ascent, per nat
DETERMINED = 0.1  # of held-out actions' variance: a clone that leaves less unexplained shows that states decide them


class Trust(nn.Module):
    """The constraint `E[-w log pi(a|s)] / A <= that of the best clone + slack`, over rows that nothing learns from.

    The weights w, divided by their sum, are by the same rule as those that the clone learned with.

    The weight of the actor's clone loss is its dual variable: it grows while the constraint is broken and shrinks while
    it is not (dual ascent, as SAC's temperature: Haarnoja et al. 2018, section 5).

    Args:
        actor: whose like are watched.

    Attributes:
        clone: the actor where it was likeliest on held-out rows.
        best: (), its error there (`Actor.clone_error`).
        determined: () bool, whether some look found that the log's actions are a function of its states.
        rows: to watch; None before there is a log.
        weigh: rows to their weights (B,), as they are at the moment.
        looked_at: the rows of each look.
    """

    best: Tensor
    determined: Tensor
    log_weight: Tensor

    def __init__(self, actor: Actor) -> None:
        super().__init__()
        self.clone = copy.deepcopy(actor).requires_grad_(False)
        self.register_buffer("best", torch.tensor(math.inf))
        self.register_buffer("determined", torch.tensor(False))
        self.register_buffer("log_weight", torch.tensor(math.log(FIRST)))
        self.rows: DrawnRows | None = None

    def begin(self, rows: DrawnRows, weigh: Callable[[Batch], Tensor], seed: int, device: torch.device) -> None:
        """Takes the rows to watch and what each weighs, (B,); draws those of each look, the same every time."""
        self.rows, self.weigh = rows, weigh
        self.looked_at = rows.draw(CHECKED, epoch_generator(seed, 0, "held out", device))

    @torch.no_grad()
    def look(self, actor: Actor) -> Tensor:
        """() the actor's error on held-out rows; the clone is the best so far, of those of one way to clone."""
        observations, actions = self.looked_at["observations"], self.looked_at["actions"]
        left = (actor.act(observations) - actions).square().mean(0).sum() / actions.var(0).sum()
        if not self.determined and left < DETERMINED:
            self.determined.fill_(True)
            self.best.fill_(math.inf)
        error = self.error(actor, self.looked_at)
        if self.best.isfinite():  # rows may weigh something else than they did at the look before
            self.best.copy_(self.error(self.clone, self.looked_at))
        if error < self.best:
            self.best.copy_(error)
            self.clone.load_state_dict(actor.state_dict())
        return error

    def error(self, actor: Actor, rows: Batch) -> Tensor:
        """() the weighted mean of `Actor.clone_error`."""
        weight = self.weigh(rows)
        return (weight * actor.clone_error(rows["observations"], rows["actions"])).sum() / weight.sum()

    @torch.no_grad()
    def excess(self, actor: Actor) -> float:
        """Nats per action dimension by which an actor is less likely than the clone."""
        return float(self.error(actor, self.looked_at) - self.best)

    @torch.no_grad()
    def ascend(self, actor: Actor, slack: float, generator: torch.Generator) -> Tensor:
        """() the dual variable after a step, on fresh rows: of `sum_d -log pi(a_d|s)`, not of its mean."""
        assert self.rows is not None
        error = self.error(actor, self.rows.draw(ROWS, generator))
        self.log_weight += RATE * (error - self.best - slack)
        self.log_weight.clamp_(math.log(LEAST), math.log(MOST))
        return self.log_weight.exp()


class WatchedWarmStart(WarmStart):
    """A warm start that ends with the actor that was likeliest on held-out rows: a narrow log is soon learned by heart.

    Args:
        updates: how many; learning rates fall over them, half a cosine.
        trust: watches.
    """

    def __init__(self, updates: int, trust: Trust) -> None:
        super().__init__(updates)
        self.trust = trust

    def rate(self, done: int) -> float:
        return LEARNING_RATE * 0.5 * (1.0 + math.cos(math.pi * done / self.updates))

    def update(self, agent: Agent, batch: Batch, done: int) -> Logs:
        logs = super().update(agent, batch, done)
        if (done + 1) % CHECK_EVERY == 0:
            logs["held_out_clone_loss"] = self.trust.look(agent.actor)
        return logs

    def finish(self, agent: Agent) -> None:
        self.trust.look(agent.actor)
        agent.actor.load_state_dict(self.trust.clone.state_dict())
        super().finish(agent)
