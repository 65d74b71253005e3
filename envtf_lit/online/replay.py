"""The newest transitions of environments that step together, on the device, drawn as n-step transitions."""

import torch
from torch import Tensor

FIRST_SIZE = 4_096  # steps that there is room for to begin with; it doubles as need be
COLUMNS = ("observations", "actions", "rewards", "next_observations", "terminated", "truncated")


class Replay:
    """A ring of transitions in the order of steps, of which the oldest leave first.

    Args:
        environments: E, that step together.
        capacity: transitions that it holds at most, rounded up to a multiple of E.
        device: where they lie.
    """

    def __init__(self, environments: int, capacity: int, device: torch.device | str = "cpu") -> None:
        self.environments, self.device = environments, torch.device(device)
        self.capacity = -(-capacity // environments) * environments
        self.added = 0  # transitions ever
        self.columns: dict[str, Tensor] = {}

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    @property
    def largest_reward(self) -> float:
        """The largest |r| that it holds; 0 where it holds nothing."""
        return float(self.columns["rewards"][: len(self)].abs().max()) if self.added else 0.0

    def add(self, rows: dict[str, Tensor]) -> None:
        """One step's transitions, (E, …) under the names in `COLUMNS`."""
        if self.added == self._room < self.capacity:
            self._grow(rows)
        slot = self.added % self.capacity
        for name, column in self.columns.items():
            column[slot : slot + self.environments] = rows[name].to(self.device)
        self.added += self.environments

    def draw(self, count: int, generator: torch.Generator, *, discount: float, n_step: int = 1) -> dict[str, Tensor]:
        """Transitions (count, …) drawn uniformly, with the columns of `loaders.Transitions`.

        Those that the newest row cuts short have fewer steps than n, and their value goes on there. `returns` are NaN:
        of an episode under way nobody knows them, and nothing that learns online may need them.
        """
        E = self.environments
        rows = torch.randint(self.added - len(self), self.added, (count,), generator=generator, device=self.device)
        path = rows[:, None] + E * torch.arange(n_step, device=self.device)  # (count, n)
        path = path.clamp(max=self.added - 1)  # what comes later is not taken, and there may be no room for it yet
        ended = self._at("terminated", path) | self._at("truncated", path)
        goes_on = ~ended & (path + E < self.added)
        taken = torch.cat([torch.ones_like(goes_on[:, :1]), goes_on[:, :-1].cumprod(1).bool()], 1)
        powers = discount ** torch.arange(n_step + 1, device=self.device)
        steps = taken.sum(1)
        last = rows + E * (steps - 1)
        following = self._at("next_observations", last)
        followed = goes_on.gather(1, steps[:, None] - 1)[:, 0]
        return dict(
            observations=self._at("observations", rows),
            actions=self._at("actions", rows),
            rewards=(taken * powers[:-1] * self._at("rewards", path)).sum(1),
            next_observations=following,
            discounts=powers[steps] * ~self._at("terminated", last),
            next_actions=self._at("actions", last + E * followed),
            followed=followed.float(),
            following_observations=self._at("next_observations", rows),
            returns=torch.full((count,), torch.nan, device=self.device),
            tails=torch.zeros(count, device=self.device),
            last_observations=following,
        )

    def state_dict(self) -> dict[str, Tensor]:
        """What it holds, oldest first."""
        order = torch.arange(self.added - len(self), self.added, device=self.device)
        return {name: self._at(name, order).cpu() for name in self.columns}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Holds that again, or its newest part where the capacity is less."""
        self.columns = {name: column[-self.capacity :].to(self.device, copy=True) for name, column in state.items()}
        self.added = self._room

    @property
    def _room(self) -> int:
        return len(self.columns["rewards"]) if self.columns else 0

    def _grow(self, rows: dict[str, Tensor]) -> None:
        held = self._room
        room = min(self.capacity, 2 * held or self.environments * FIRST_SIZE)
        for name in COLUMNS:
            kept = rows[name].to(self.device)
            grown = torch.zeros(room, *kept.shape[1:], dtype=kept.dtype, device=self.device)
            if name in self.columns:
                grown[:held] = self.columns[name]
            self.columns[name] = grown

    def _at(self, name: str, rows: Tensor) -> Tensor:
        """A column's rows by their numbers since the beginning."""
        return self.columns[name][rows % self.capacity]
