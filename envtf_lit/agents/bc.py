"""Behaviour cloning: the policy of the log, by maximum likelihood; of all of it, or of its best episodes."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from envtf_lit.agents.agent import Agent
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.phases import Batch, Logs, Part
from envtf_lit.data.datamodules import TransitionData
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.options.numbers import NonzeroShare
from envtf_lit.options.schema import rare


@dataclass(frozen=True)
class BCOptions(PolicyOptions):
    """Behaviour cloning's own option; with a `return_temperature`, too, it clones the best episodes most.

    Attributes:
        best_share: of the episodes, those of the highest returns, which rows are drawn from: 0.1 is 10 %-BC.
    """

    best_share: NonzeroShare = rare(1.0)


class BC(Agent):
    """Maximises `log pi(a|s)` of a squashed Gaussian over the log's rows."""

    Options: ClassVar[type[PolicyOptions]] = BCOptions
    label = "BC"
    options: BCOptions

    def setup(self, stage: str) -> None:
        if self.options.best_share < 1:
            data: TransitionData = self.trainer.datamodule  # pyright: ignore[reportAttributeAccessIssue]
            data.chances = best_rows(data.dataset, self.options.best_share)
        super().setup(stage)

    def parts(self) -> dict[str, Part]:
        return dict(actor=Part(self.actor, self.options.actor_learning_rate))

    def losses(self, batch: Batch) -> Iterator[tuple[str, Tensor, Logs]]:
        loss = self.clone_loss(batch)
        yield "actor", loss, dict(clone_loss=loss)


def best_rows(dataset: OfflineDataset, share: float) -> Tensor:
    """(N,) 1 for rows of this share of the episodes, those of the highest returns, else 0 (Chen et al. 2021, 5.1).

    At least one episode; of equal returns the earlier ones.
    """
    returns = torch.as_tensor(dataset.episode_returns)
    best = torch.zeros(len(returns))
    best[returns.argsort(descending=True, stable=True)[: max(1, round(share * len(returns)))]] = 1.0
    return best[torch.as_tensor(dataset.episode_index)]
