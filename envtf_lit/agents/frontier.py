"""The frontier of trust: actors from the clone outward, what the model promises of each, and which one is kept."""

import copy
import math
from dataclasses import astuple
from typing import Any

import torch
from torch import Tensor, nn

from envtf_lit.actors import Actor
from envtf_lit.agents.trust_levels import COLUMNS, LEAST_GAIN
from envtf_lit.critics import StackedCritics
from envtf_lit.imagination.promise import Promise


class Frontier(nn.Module):
    """Actors in the order in which they left the log, each with critics; the first is the clone. Part of checkpoints.

    Args:
        actor, critics: whose like they are.
        places: for how many there is room.
    """

    table: Tensor
    count: Tensor
    kept: Tensor

    def __init__(self, actor: Actor, critics: StackedCritics, places: int) -> None:
        super().__init__()
        self.actors = nn.ModuleList(copy.deepcopy(actor).requires_grad_(False) for _ in range(places))
        self.critics = nn.ModuleList(copy.deepcopy(critics).requires_grad_(False) for _ in range(places))
        self.register_buffer("table", torch.full((places, len(COLUMNS)), math.nan, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.long))
        self.register_buffer("kept", torch.zeros((), dtype=torch.long))

    def add(self, actor: Actor, critics: StackedCritics, *, update: int, excess: float, promise: Promise) -> None:
        """A further actor, `excess` nats per action dimension less likely than the clone."""
        place = int(self.count)
        self.actors[place].load_state_dict(actor.state_dict())
        self.critics[place].load_state_dict(critics.state_dict())
        row = (float(update), excess, *astuple(promise))
        self.table[place] = torch.tensor(row, dtype=torch.float64)
        self.count += 1

    def choose(self, price: float) -> nn.Module:
        """The actor whose promise is best for its distance; the clone, unless another's is better by `LEAST_GAIN`.

        `(promise - standard error) / |promise of the clone| - price * excess`, the excess in nats. All are promised in
        the same model, whose errors they share: what counts is the difference.
        """
        _, excess, promise, error, *_ = self.table[: int(self.count)].unbind(1)
        worth = (promise - error - promise[0]) / promise[0].abs().clamp(min=1e-9) - price * excess.clamp(min=0.0)
        worth[0] = LEAST_GAIN
        self.kept.fill_(worth.argmax())
        return self.actors[int(self.kept)]

    def rows(self) -> list[dict[str, Any]]:
        """What is known of each actor; `kept` is 1 for the one that is published."""
        return [
            dict(zip(COLUMNS, row, strict=True)) | {"kept": int(place == int(self.kept))}
            for place, row in enumerate(self.table[: int(self.count)].tolist())
        ]
