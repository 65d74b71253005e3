"""Causal sliding-window attention with rotary positions, and its cache."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from envtf_lit.world_models.options import ModelOptions

LARGE_CACHE = 2**18  # numbers; beyond, a CPU takes the cache token by token, whose products then stay in its own caches


def rotation(positions: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Cosines and signed sines (..., width) of the rotary embedding (Su et al. 2021) at integer positions (...)."""
    half = width // 2
    frequency = 10_000.0 ** (-torch.arange(half, device=positions.device, dtype=torch.float32) / half)
    angle = positions.float()[..., None] * frequency  # (..., width/2)
    sin = angle.sin()
    return torch.cat([angle.cos()] * 2, -1), torch.cat([-sin, sin], -1)


def rotate(x: Tensor, cos_sin: tuple[Tensor, Tensor]) -> Tensor:
    """Heads (..., d) turned by a `rotation`, broadcast against them: entries i and i + d/2 are one pair."""
    cos, sin = cos_sin
    return x * cos.to(x.dtype) + x.roll(x.shape[-1] // 2, -1) * sin.to(x.dtype)


def window_mask(length: int, context: int, device: torch.device) -> Tensor:
    """(T, T) bool: token i may look at tokens i - context + 1 … i."""
    distance = torch.arange(length, device=device)[:, None] - torch.arange(length, device=device)
    return (distance >= 0) & (distance < context)


class Attention(nn.Module):
    """Causal multi-head attention over a sliding window, for whole sequences and for one token at a time."""

    def __init__(self, options: ModelOptions) -> None:
        super().__init__()
        self.heads, self.context, self.dropout = options.heads, options.context, options.dropout
        self.qkv = nn.Linear(options.width, 3 * options.width)
        self.out = nn.Linear(options.width, options.width)

    def project(self, x: Tensor, cos_sin: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """(B, T, D), and the `rotation` (T, d), to rotated queries and keys, and values, each (B, H, T, d)."""
        B, T, D = x.shape
        qkv = self.qkv(x).view(B, T, 3, self.heads, D // self.heads)
        cos, sin = cos_sin
        q, k = rotate(qkv[:, :, :2], (cos[:, None, None], sin[:, None, None])).permute(2, 0, 3, 1, 4)
        return q, k, qkv[:, :, 2].transpose(1, 2)

    def project_token(self, x: Tensor, cos_sin: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """(B, D), and the `rotation` (1, d) of their common position, to what `project` gives, each (B, H, d)."""
        B, D = x.shape
        if B < 8 * D:
            qkv = self.qkv(x).view(B, 3, self.heads, D // self.heads)
            q, k = rotate(qkv[:, :2], cos_sin).unbind(1)
            return q, k, qkv[:, 2]
        # many rows: the rotation is linear and the same for all, so that it can turn the weights in their place
        weight, bias = (p.view(3, self.heads, D // self.heads, -1).mT for p in (self.qkv.weight, self.qkv.bias))
        weight, bias = (torch.cat([rotate(p[:2], cos_sin), p[2:]]).mT.reshape(3 * D, -1) for p in (weight, bias))
        q, k, v = F.linear(x, weight, bias[:, 0]).view(B, 3, self.heads, D // self.heads).unbind(1)
        return q, k, v

    def forward(self, q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None) -> Tensor:
        """Whole sequences (B, H, T, d); `mask` None means plain causal attention."""
        T = q.shape[2]
        # torch's fused kernel has a bf16 backward pass five to eight times slower on a CPU, and on a GPU, for sequences
        # of one token, one that doubles the time of the whole step
        if q.device.type == "cpu" or T == 1:
            y = self._products(q, k, v, window_mask(T, T, q.device) if mask is None else mask)
        else:
            dropout = self.dropout if self.training else 0.0
            y = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, is_causal=mask is None, dropout_p=dropout)
        return self.out(y.transpose(1, 2).flatten(2))  # (B, T, D)

    def _products(self, q: Tensor, k: Tensor, v: Tensor, mask: Tensor) -> Tensor:
        score = (q @ k.transpose(-2, -1) * q.shape[-1] ** -0.5).masked_fill(~mask, float("-inf"))  # (B, H, T, T)
        weight = F.dropout(score.float().softmax(-1), self.dropout, self.training)
        return weight.to(v.dtype) @ v

    def recall(self, q: Tensor, keys: Tensor, values: Tensor, mask: Tensor | None) -> Tensor:
        """One token's queries (B, H, d) over cached keys and values (C, B, H, d); `mask` is (C, B, 1)."""
        with torch.autocast(q.device.type, enabled=False):  # or a cache in fp32 would be cast, whole, at every step
            score = _scores(q.float(), keys) * q.shape[-1] ** -0.5  # (C, B, H)
            if mask is not None:
                score = score.masked_fill(~mask, float("-inf"))
            weight = F.dropout(score.softmax(0), self.dropout, self.training)
            y = _mixture(weight, values)
        return self.out(y.flatten(1))  # (B, D)


def _token_by_token(cache: Tensor) -> bool:
    return cache.device.type == "cpu" and cache.numel() > LARGE_CACHE


def _scores(q: Tensor, keys: Tensor) -> Tensor:
    """Products (C, B, H) of queries (B, H, d) with keys (C, B, H, d)."""
    if _token_by_token(keys):
        return torch.stack([(q * key).sum(-1) for key in keys.unbind()])
    return (q * keys).sum(-1)


def _mixture(weight: Tensor, values: Tensor) -> Tensor:
    """Sums (B, H, d) of values (C, B, H, d), weighted by (C, B, H)."""
    if not _token_by_token(values):
        return (weight.unsqueeze(-1) * values).sum(0)
    first, *others = zip(weight.unsqueeze(-1).unbind(), values.unbind(), strict=True)
    y = first[0] * first[1]
    for w, value in others:
        y = y.addcmul_(w, value)
    return y


class Block(nn.Module):
    """A pre-norm transformer block."""

    def __init__(self, options: ModelOptions) -> None:
        super().__init__()
        activation = {"relu": nn.ReLU, "gelu": nn.GELU}[options.activation]
        self.attention_norm = nn.LayerNorm(options.width)
        self.attention = Attention(options)
        self.mlp_norm = nn.LayerNorm(options.width)
        self.mlp = nn.Sequential(
            nn.Linear(options.width, 4 * options.width), activation(), nn.Linear(4 * options.width, options.width)
        )
        self.dropout = nn.Dropout(options.dropout)

    def advance(
        self,
        x: Tensor,
        keys: Tensor,
        values: Tensor,
        mask: Tensor | None,
        clock: int,
        cos_sin: tuple[Tensor, Tensor],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The next token (B, D) of all rows, given the cache that it is written to; its output, and the cache."""
        context = keys.shape[0]
        q, k, v = self.attention.project_token(self.attention_norm(x), cos_sin)
        slot, filled = clock % context, min(clock + 1, context)
        keys, values = _write(keys, k, slot), _write(values, v, slot)
        return self.finish(x, self.attention.recall(q, keys[:filled], values[:filled], mask)), keys, values

    def finish(self, x: Tensor, attended: Tensor) -> Tensor:
        """The residual sums of both branches, given what attention returned."""
        x = x + self.dropout(attended)
        return x + self.dropout(self.mlp(self.mlp_norm(x)))


def _write(cache: Tensor, token: Tensor, slot: int) -> Tensor:
    """Puts (B, H, d) into a slot of (C, B, H, d): in place, or into a copy when gradients flow through it."""
    if torch.is_grad_enabled() and (token.requires_grad or cache.requires_grad):
        cache = cache.clone()
    cache[slot] = token
    return cache
