"""Behaviour cloning: the policy of the log, by maximum likelihood."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from envtf_lit.agents.agent import Agent, Batch, Logs, Part
from envtf_lit.agents.options import PolicyOptions


@dataclass(frozen=True)
class BCOptions(PolicyOptions):
    """Behaviour cloning has the common options alone; with a `return_temperature` it clones the best episodes most."""


class BC(Agent):
    """Maximises `log pi(a|s)` of a squashed Gaussian over the log's rows."""

    Options: ClassVar[type[PolicyOptions]] = BCOptions
    label = "BC"

    def parts(self) -> dict[str, Part]:
        return dict(actor=Part(self.actor, self.options.actor_learning_rate))

    def losses(self, batch: Batch) -> Iterator[tuple[str, Tensor, Logs]]:
        loss = self.clone_loss(batch)
        yield "actor", loss, dict(clone_loss=loss)
