"""Q-functions, all members of a stack in one batched product, and the value of states."""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from envtf_lit.actors import in_fp32, mlp


class StackedLinear(nn.Module):
    """n linear layers side by side: (n, B, in) to (n, B, out).

    Args:
        n: how many.
        fan_in, fan_out: sizes.
        beside: further inputs, whose part of the sum another layer computes; they count in the initialisation, which is
            torch.nn.Linear's of both together.
        bias: whether there is one; of layers that are summed, in one.
    """

    def __init__(self, n: int, fan_in: int, fan_out: int, *, beside: int = 0, bias: bool = True) -> None:
        super().__init__()
        bound = 1.0 / math.sqrt(fan_in + beside)
        self.weight = nn.Parameter(torch.empty(n, fan_in, fan_out).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(n, 1, fan_out).uniform_(-bound, bound)) if bias else None

    def forward(self, x: Tensor) -> Tensor:
        return torch.bmm(x, self.weight) if self.bias is None else torch.baddbmm(self.bias, x, self.weight)


class StackedCritics(nn.Module):
    """n independent Q-functions `Q_i(s, a)`, each an MLP with ReLU and, if wanted, LayerNorm.

    The first layer's state part is computed once per state, however many actions are asked about.
    """

    observation_mean: Tensor
    observation_std: Tensor

    def __init__(
        self, observation_dim: int, action_dim: int, *, n: int = 2, hidden: Sequence[int], layer_norm: bool
    ) -> None:
        super().__init__()
        self.from_observation = StackedLinear(n, observation_dim, hidden[0], beside=action_dim)
        self.from_action = StackedLinear(n, action_dim, hidden[0], beside=observation_dim, bias=False)
        self.hidden = nn.ModuleList(StackedLinear(n, a, b) for a, b in pairwise(hidden))
        self.out = StackedLinear(n, hidden[-1], 1)
        self.n, self.layer_norm = n, layer_norm
        self.register_buffer("observation_mean", torch.zeros(observation_dim))
        self.register_buffer("observation_std", torch.ones(observation_dim))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Observation (B, S) and action (B, A) to (n, B); with several actions (B, N, A) to (n, B, N). fp32."""
        B, N = len(observation), action.shape[1] if action.dim() == 3 else 1
        scaled = (observation - self.observation_mean) / self.observation_std
        state_part = self.from_observation(scaled.expand(self.n, -1, -1))  # (n, B, H)
        action_part = self.from_action(action.reshape(B * N, -1).expand(self.n, -1, -1))  # (n, B*N, H)
        x = self._activate(state_part.unsqueeze(2) + action_part.unflatten(1, (B, N))).flatten(1, 2)  # (n, B*N, H)
        for layer in self.hidden:
            x = self._activate(layer(x))
        q = in_fp32(self.out, x)[..., 0]  # (n, B*N)
        return q.view(self.n, B, N) if action.dim() == 3 else q

    def _activate(self, x: Tensor) -> Tensor:
        """In place on a tensor of its own: of a view, autograd would copy the whole."""
        if self.layer_norm:  # without gain and shift: a rectifier follows, so no later layer could make up for a shift
            with torch.autocast(x.device.type, enabled=False):  # sums in fp32 anyway; the next product takes bf16
                x = F.layer_norm(x, x.shape[-1:])
        return F.relu(x, inplace=True)


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
