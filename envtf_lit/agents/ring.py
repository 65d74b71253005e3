"""A ring of imagined transitions: part of the agent's state, so that a resumed run goes on with the same ones."""

import torch
from torch import Tensor, nn


class ImaginedRing(nn.Module):
    """Holds the newest `capacity` imagined transitions; the oldest leave first."""

    count: Tensor

    def __init__(self, observation_dim: int, action_dim: int, capacity: int) -> None:
        super().__init__()
        self.capacity = capacity
        self.widths = dict(
            observations=(observation_dim,),
            actions=(action_dim,),
            rewards=(),
            next_observations=(observation_dim,),
            discounts=(),
        )
        for name, shape in self.widths.items():
            self.register_buffer(name, torch.zeros(capacity, *shape))
        self.register_buffer("count", torch.zeros((), dtype=torch.long))  # transitions ever added

    def __len__(self) -> int:
        return min(int(self.count), self.capacity)

    def add(self, transitions: dict[str, Tensor]) -> None:
        """Writes all transitions, over the oldest ones if need be."""
        number, start = len(transitions["rewards"]), int(self.count)
        kept = torch.arange(max(0, number - self.capacity), number, device=self.count.device)
        slots = (start + kept) % self.capacity
        for name in self.widths:
            self.get_buffer(name)[slots] = transitions[name][kept].to(self.count.device, torch.float32)
        self.count += number

    def draw(self, count: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Uniform transitions, each column (count, …)."""
        rows = torch.randint(len(self), (count,), generator=generator, device=self.count.device)
        return {name: getattr(self, name)[rows] for name in self.widths}
