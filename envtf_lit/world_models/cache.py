"""The Environment Transformer's state in a rollout: a ring cache of keys and values beside the current observation."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from envtf_lit.world_models.attention import rotate, rotation
from envtf_lit.world_models.options import ModelOptions


@dataclass(frozen=True)
class TransformerState:
    """State of a batch of B rollouts: the ring cache, the clock, and the observation that has no action yet.

    Attributes:
        cache: per layer, keys and values (context, B, H, d), in `cache_type`; token t lies in slot t mod context, and
            slots that have held none hold nothing.
        clock: position of the next token, the same for all rows (histories are right-aligned).
        first: (B,) position of each row's first token, or None where all rows began at 0.
        observation: (B, S) current observation.
        drawn: (B, D + 1, S + 1) each row's last layer, drawn from the posterior; None where all use the trained one.
    """

    cache: list[tuple[Tensor, Tensor]]
    clock: int
    first: Tensor | None
    observation: Tensor
    drawn: Tensor | None = None

    @classmethod
    def empty(cls, options: ModelOptions, observation: Tensor, drawn: Tensor | None = None) -> "TransformerState":
        """Rollouts at their first observation (B, S), with no token in the cache."""
        size = (options.context, len(observation), options.heads, options.width // options.heads)
        kind = cache_type(observation.device)
        cache = [
            (observation.new_empty(size, dtype=kind), observation.new_empty(size, dtype=kind))
            for _ in range(options.layers)
        ]
        return cls(cache, 0, None, observation, drawn)

    @property
    def context(self) -> int:
        """Slots of the ring."""
        return self.cache[0][0].shape[0]

    def with_history(self, tokens: list[tuple[Tensor, Tensor]], window: Tensor, lengths: Tensor) -> "TransformerState":
        """The same rollouts with their histories in the (empty) cache, right-aligned.

        Args:
            tokens: per layer, keys and values (W, H, T, d) of windows, the keys rotated by their positions there.
            window: (B,) the window of each rollout.
            lengths: (B,) observations of it that the rollout has seen, the current one among them.
        """
        clock = min(tokens[0][0].shape[2], self.context - 1)  # all rows' tokens before the current states lie in it
        shift = clock - (lengths - 1)  # (B,) from a token's position in the window to that in the cache
        index = torch.arange(clock, device=shift.device)[:, None] - shift  # (clock, B)
        first = shift.clamp(min=0) if bool((shift > 0).any()) else None
        turn = rotation(shift[:, None], self.cache[0][0].shape[-1])
        for (keys, values), (k, v) in zip(self.cache, tokens, strict=True):
            k, v = (x.transpose(1, 2)[window, index.clamp(min=0)] for x in (k, v))  # (clock, B, H, d)
            keys[:clock], values[:clock] = rotate(k.float(), turn), v
        return replace(self, clock=clock, first=first)

    def visible(self) -> Tensor | None:
        """(slots filled with the next token, B, 1) bool, which hold a token of the row itself; None where all do."""
        if self.first is None:
            return None
        slot = torch.arange(min(self.clock + 1, self.context), device=self.observation.device)
        position = self.clock - (self.clock - slot) % self.context
        return (position[:, None] >= self.first)[..., None]

    def gather(self, index: Tensor) -> "TransformerState":
        """The rows of these indices (K,), in the order given."""
        filled = min(self.clock, self.context)
        cache = [(_take(keys, index, filled), _take(values, index, filled)) for keys, values in self.cache]
        first = None if self.first is None else self.first[index]
        drawn = None if self.drawn is None else self.drawn[index]
        return TransformerState(cache, self.clock, first, self.observation[index], drawn)


def cache_type(device: torch.device) -> torch.dtype:
    """As matrix products give keys and values on an accelerator, whose memory full caches fill; elsewhere fp32."""
    kept_short = device.type != "cpu" and torch.is_autocast_enabled(device.type)
    return torch.get_autocast_dtype(device.type) if kept_short else torch.float32


def _take(cache: Tensor, index: Tensor, filled: int) -> Tensor:
    """These rows of a cache (C, B, H, d), of which the first so many slots are filled."""
    taken = cache.new_empty(cache.shape[0], len(index), *cache.shape[2:])
    taken[:filled] = cache[:filled, index]
    return taken
