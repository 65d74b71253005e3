"""Advantages over the log: how much better a row went on than its state does, and what it weighs for that."""

import torch
from torch import Tensor

from envtf_lit.agents.networks import PlainStateValue
from envtf_lit.agents.phases import Batch

LARGEST_WEIGHT = 20.0  # of a row, as AWR has it


class AdvantageWeights:
    """For agents that clone better rows more (MARWIL, Wang et al. 2018; AWR, Peng et al. 2019).

    Attributes:
        value: of the log's states, under the policies that it was recorded with.
    """

    value: PlainStateValue

    @torch.no_grad()
    def complete_returns(self, batch: Batch) -> Batch:
        """`G + gamma^n V(s_T)` for episodes that were cut after n steps, in s_T; what terminated keeps its return."""
        return batch | {"returns": batch["returns"] + batch["tails"] * self.value(batch["last_observations"])}

    def value_loss(self, batch: Batch) -> Tensor:
        """`(V(s) - G)^2`, G the Monte-Carlo return that was recorded (AWR, equation 3)."""
        return (self.value(batch["observations"]) - batch["returns"]).square().mean()

    @torch.no_grad()
    def advantage_weights(self, batch: Batch, beta: float) -> Tensor:
        """(B,) `min(exp(beta (G - V(s)) / c), 20)`, c the advantages' root mean square (MARWIL, section 4.2).

        The scale of rewards does not matter; c is that of the batch, where MARWIL has a moving mean.
        """
        advantage = batch["returns"] - self.value(batch["observations"])
        scale = advantage.square().mean().sqrt().clamp(min=1e-6)
        return torch.exp(beta * advantage / scale).clamp(max=LARGEST_WEIGHT)
