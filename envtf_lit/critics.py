"""Q-functions: all members of a stack in one batched product, and those that are kept beside the policy they judge."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from envtf_lit.actors import Actor, in_fp32
from envtf_lit.errors import UserError
from envtf_lit.model_folders import load_module, save_module
from envtf_lit.policy import load_policy

CRITICS = "critics"  # below the policy


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


class Critics(nn.Module):
    """Q-functions in units of the log's own rewards: a stack, times the scale that rewards were divided by.

    Args:
        observation_dim, action_dim: S and A.
        n, hidden, layer_norm: as of `StackedCritics`.
        discount: of the returns that they predict, per step.

    Attributes:
        arguments: the constructor's, to build the module again.
        return_scale: () that the stack's Q is multiplied by.

    Raises:
        ValueError: no members, no hidden layer, or a discount outside (0, 1].
    """

    return_scale: Tensor

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        n: int,
        hidden: Sequence[int],
        layer_norm: bool,
        discount: float,
    ) -> None:
        super().__init__()
        if n < 1 or not hidden or not 0 < discount <= 1:
            raise ValueError(f"n is {n}, hidden {hidden} and discount {discount}")
        self.arguments: dict[str, Any] = dict(
            observation_dim=observation_dim,
            action_dim=action_dim,
            n=n,
            hidden=list(hidden),
            layer_norm=layer_norm,
            discount=discount,
        )
        self.discount = discount
        self.stack = StackedCritics(observation_dim, action_dim, n=n, hidden=hidden, layer_norm=layer_norm)
        self.register_buffer("return_scale", torch.ones(()))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Shapes as of `StackedCritics`."""
        return self.return_scale * self.stack(observation, action)


KINDS = {"critics": Critics}


def save_critics(policy: str | Path, critics: Critics) -> None:
    """Writes critics below the folder of their policy, as safetensors beside JSON."""
    save_module(Path(policy) / CRITICS, critics, kind="critics", arguments=critics.arguments)


@dataclass(frozen=True, eq=False)
class PolicyCritics:
    """A policy and what it is worth, in the log's own rewards, discounted by `critics.discount` per step.

    Attributes:
        critics: Q-functions, in eval mode; no gradient reaches their weights.
        policy: whose actions they judge.
    """

    critics: Critics
    policy: Actor

    def q(self, observation: Tensor, action: Tensor) -> Tensor:
        """`min_i Q_i(s, a)`: observations (B, S) and actions (B, A) to (B,), or several (B, N, A) to (B, N)."""
        return self.critics(observation, action).min(0).values

    def value(self, observation: Tensor) -> Tensor:
        """`V(s) = min_i Q_i(s, pi(s))`, pi without noise: observations (B, S) to (B,)."""
        return self.q(observation, self.policy.act(observation))


def load_critics(policy: str | Path) -> PolicyCritics:
    """The critics saved below a policy's folder, with the policy.

    Raises:
        UserError: the folder has none, such as that of an algorithm without critics, or they are damaged or of other
            sizes than the policy.
    """
    actor, place = load_policy(policy, guarded=False), Path(policy) / CRITICS
    if not place.is_dir():
        raise UserError(
            f"{policy} has no critics: its algorithm learns none, or an earlier version trained it; train it anew with "
            "one that learns them, such as et_cql."
        )
    critics = load_module(place, KINDS).requires_grad_(False)
    scale = float(critics.return_scale)
    if not 0 < scale < math.inf:
        raise UserError(f"{place} is in no units, its return_scale is {scale}: train the policy anew.")
    sizes = critics.arguments["observation_dim"], critics.arguments["action_dim"]
    own = len(actor.observation_mean), len(actor.action_low)
    if sizes != own:
        raise UserError(
            f"{place} judges observations of size {sizes[0]} and actions of size {sizes[1]}, and the policy has "
            f"{own[0]} and {own[1]}: they do not belong together, so train the policy anew."
        )
    return PolicyCritics(critics, actor)
