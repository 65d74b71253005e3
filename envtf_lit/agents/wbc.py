"""Advantage-weighted cloning (MARWIL, Wang et al. 2018; AWR, Peng et al. 2019): better actions are cloned more."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from envtf_lit.agents.advantages import AdvantageWeights
from envtf_lit.agents.agent import Agent
from envtf_lit.agents.networks import PlainStateValue
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.phases import Batch, Logs, Part
from envtf_lit.options.numbers import Sharpness


@dataclass(frozen=True)
class WBCOptions(PolicyOptions):
    """Advantage-weighted cloning's own option.

    Attributes:
        beta: by which advantages, in units of their root mean square, are multiplied in the weights exp(beta A); 0
            clones all rows alike.
    """

    beta: Sharpness = 1.0


class WBC(AdvantageWeights, Agent):
    """Clones the log, each row with a weight that says how much better it went on than its state's value."""

    Options: ClassVar[type[PolicyOptions]] = WBCOptions
    label = "Weighted BC"
    options: WBCOptions

    def build_networks(self) -> None:
        o = self.options
        self.value = PlainStateValue(self.observation_dim, hidden=o.hidden, layer_norm=o.layer_norm)

    def parts(self) -> dict[str, Part]:
        o = self.options
        return dict(value=Part(self.value, o.critic_learning_rate), actor=Part(self.actor, o.actor_learning_rate))

    def losses(self, batch: Batch) -> Iterator[tuple[str, Tensor, Logs]]:
        batch = self.complete_returns(batch)
        loss = self.value_loss(batch)
        yield "value", loss, dict(value_loss=loss)
        yield "actor", *self.actor_loss(batch)

    def actor_loss(self, batch: Batch) -> tuple[Tensor, Logs]:
        """`-w log pi(a|s)`, w the row's advantage weight (MARWIL, section 4.2)."""
        weight = self.advantage_weights(batch, self.options.beta)
        error = self.actor.clone_error(batch["observations"], batch["actions"])
        loss = (weight * error).mean()
        return loss, dict(clone_loss=error.mean(), weighted_clone_loss=loss, weight=weight.mean())
