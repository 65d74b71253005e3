"""The values of states, which some algorithms learn beside the value of actions."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from envtf_lit.actors import in_fp32, mlp


class PlainStateValue(nn.Module):
    """`V(s)`, an MLP with ReLU and, if wanted, LayerNorm, as the critics are: no actor follows its gradient."""

    observation_mean: Tensor
    observation_std: Tensor

    def __init__(self, observation_dim: int, *, hidden: Sequence[int], layer_norm: bool) -> None:
        super().__init__()
        self.net = mlp([observation_dim, *hidden, 1], layer_norm=layer_norm)
        self.register_buffer("observation_mean", torch.zeros(observation_dim))
        self.register_buffer("observation_std", torch.ones(observation_dim))

    def forward(self, observation: Tensor) -> Tensor:
        """Observations (B, S) to (B,), fp32."""
        x = (observation - self.observation_mean) / self.observation_std
        *layers, last = self.net
        for layer in layers:
            x = layer(x)
        return in_fp32(last, x)[..., 0]


class StateValue(nn.Module):
    """`V(s)`, an MLP with SiLU and LayerNorm (without gain and shift): smooth, since actors follow its gradient."""

    observation_mean: Tensor
    observation_std: Tensor

    def __init__(self, observation_dim: int, *, hidden: Sequence[int]) -> None:
        super().__init__()
        sizes = [observation_dim, *hidden]
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        self.out = nn.Linear(hidden[-1], 1)
        self.register_buffer("observation_mean", torch.zeros(observation_dim))
        self.register_buffer("observation_std", torch.ones(observation_dim))

    def forward(self, observation: Tensor) -> Tensor:
        """Observations (..., S) to (...), fp32."""
        x = (observation - self.observation_mean) / self.observation_std
        for layer in self.hidden:
            x = layer(x)
            x = F.silu(F.layer_norm(x, x.shape[-1:]))
        return in_fp32(self.out, x)[..., 0]
