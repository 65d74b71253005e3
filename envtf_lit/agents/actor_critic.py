"""What agents with critics share: their slow targets, a warm start, the actor's schedule."""

import contextlib
import copy
import math
from collections.abc import Iterator, Mapping
from typing import ClassVar

import torch
from torch import Tensor, nn

from envtf_lit.agents.agent import Agent
from envtf_lit.agents.networks import StackedCritics
from envtf_lit.agents.phases import Batch, Logs, Losses, Phase, follow
from envtf_lit.agents.warm_start import WarmStart

WARM_TARGET_RATE = 0.05  # share of the critics that enters the target networks at each update of the warm start
CRITICS = 2  # of which targets and actor take the smallest


class ActorCritic(Agent):
    """An actor, critics `Q_i(s, a)` and target critics that follow them."""

    cures: ClassVar[Mapping[str, str]] = {
        "": "lower critic_learning_rate, or warm up for longer with a larger warm_start"
    }

    def build_networks(self) -> None:
        o = self.options
        self.critics = StackedCritics(
            self.observation_dim, self.action_dim, n=CRITICS, hidden=o.hidden, layer_norm=o.layer_norm
        )
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)

    def build_phases(self) -> list[Phase]:
        warm = self.options.warm_updates
        return [WarmStart(warm), Losses(self.options.updates - warm)]

    def rate(self, part: str, progress: float) -> float:
        rate = super().rate(part, progress)
        if part == "actor" and self.options.actor_schedule == "cosine":
            rate *= 0.5 * (1.0 + math.cos(math.pi * progress))
        return rate

    def update_targets(self) -> None:
        """Target critics follow the critics, the averaged actor the actor."""
        follow(self.target_critics, self.critics, self.options.target_rate)
        super().update_targets()

    @torch.no_grad()
    def complete_returns(self, batch: Batch) -> Batch:
        """`G + gamma^n min_i Q_i'(s_T, a'), a' ~ pi(s_T)` for episodes that were cut after n steps, in s_T.

        What terminated keeps its return. The targets Q' follow the critics faster than later on: every other row holds
        them to what was earned, so that nothing can run away.
        """
        follow(self.target_critics, self.critics, WARM_TARGET_RATE)
        action = self.actor.act(batch["last_observations"], deterministic=False, generator=self.generator)
        beyond = self.target_critics(batch["last_observations"], action).min(0).values
        return batch | {"returns": batch["returns"] + batch["tails"] * beyond}

    def warm_start_losses(self, batch: Batch) -> Iterator[tuple[str, Tensor, Logs]]:
        """Critics regress on Monte-Carlo returns of the log, as `complete_returns` makes them; the actor clones it."""
        q = self.critics(batch["observations"], batch["actions"])
        loss = 0.5 * (q - batch["returns"]).square().mean(1).sum()
        yield "critics", loss, dict(warm_critic_loss=loss, q_data=q.mean())
        yield from super().warm_start_losses(batch)

    def end_warm_start(self) -> None:
        self.target_critics.load_state_dict(self.critics.state_dict())
        super().end_warm_start()

    def validation_logs(self, batch: Batch) -> Logs:
        q = self.return_scale * self.critics(batch["observations"], batch["actions"]).min(0).values
        returns = batch["returns"] + batch["tails"] * self.log_returns.typical
        return dict(q_data=q.mean(), return_error=((q - returns) / self.log_returns.spread).square().mean())


@contextlib.contextmanager
def held_fixed(module: nn.Module) -> Iterator[None]:
    """Gradients pass through a module's parameters, but do not reach them."""
    module.requires_grad_(False)
    try:
        yield
    finally:
        module.requires_grad_(True)
