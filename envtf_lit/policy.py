"""Policies: the protocol that everything acting follows, and the squashed Gaussian actor that all of ours are."""

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Protocol, cast, runtime_checkable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from envtf_lit.errors import UserError
from envtf_lit.modules import load_module, save_module

LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0


class Policy(Protocol):
    """Anything that acts: agents, behaviour policies, planners, exported models."""

    def act(self, observation: Tensor, deterministic: bool = True, generator: torch.Generator | None = None) -> Tensor:
        """Observations (B, S) to actions (B, A) in the environment's own action range."""
        ...


@runtime_checkable
class StatefulPolicy(Policy, Protocol):
    """A policy that remembers the episodes it is in, such as a planner; its rows stay the same ones."""

    def reset(self) -> None:
        """Forgets them: others begin."""
        ...


def begin_episodes(policy: Policy) -> None:
    """Says that new episodes begin, to a policy that would remember the old ones."""
    if isinstance(policy, StatefulPolicy):
        policy.reset()


def mlp(sizes: Sequence[int], *, layer_norm: bool = False) -> nn.Sequential:
    """Linear layers of these sizes with ReLU (after an optional LayerNorm) between them."""
    layers: list[nn.Module] = []
    for index, (fan_in, fan_out) in enumerate(pairwise(sizes)):
        layers.append(nn.Linear(fan_in, fan_out))
        if index < len(sizes) - 2:
            layers += [nn.LayerNorm(fan_out), nn.ReLU()] if layer_norm else [nn.ReLU()]
    return nn.Sequential(*layers)


class TanhGaussianActor(nn.Module):
    """`a = tanh(x), x ~ N(mean(s), std(s))`, scaled to the action space (Haarnoja et al. 2018, appendix C).

    Observations are z-scored by buffers inside the module, so that a saved actor needs nothing beside it.
    """

    observation_mean: Tensor
    observation_std: Tensor
    action_low: Tensor
    action_high: Tensor

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        hidden: Sequence[int] = (256, 256),
        layer_norm: bool = False,
        log_std_min: float = LOG_STD_MIN,
        action_low: Sequence[float] | None = None,
        action_high: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        self.arguments = dict(
            observation_dim=observation_dim,
            action_dim=action_dim,
            hidden=list(hidden),
            layer_norm=layer_norm,
            log_std_min=log_std_min,
            action_low=list(action_low) if action_low is not None else None,
            action_high=list(action_high) if action_high is not None else None,
        )
        self.net = mlp([observation_dim, *hidden, 2 * action_dim], layer_norm=layer_norm)
        self.log_std_min = log_std_min
        self.register_buffer("observation_mean", torch.zeros(observation_dim))
        self.register_buffer("observation_std", torch.ones(observation_dim))
        low = -1.0 if action_low is None else torch.as_tensor(action_low, dtype=torch.float32)
        high = 1.0 if action_high is None else torch.as_tensor(action_high, dtype=torch.float32)
        self.register_buffer("action_low", torch.zeros(action_dim) + low)
        self.register_buffer("action_high", torch.zeros(action_dim) + high)

    @torch.no_grad()
    def start_from(self, other: "TanhGaussianActor") -> None:
        """Takes over another actor's layers; this one keeps its scales, which are those of its own data.

        The hidden layers must be alike. A first layer for observations of the same size is taken over too, rescaled so
        that it sees what it saw; so is a last one for actions of the same size, which then mean the same shares of the
        range. Others begin anew.

        Raises:
            UserError: the hidden layers differ.
        """
        for name in ("hidden", "layer_norm", "log_std_min"):
            mine, theirs = self.arguments[name], other.arguments[name]
            if mine != theirs:
                raise UserError(f"{name} is {theirs} there and {mine} here; leave it as it is there.")
        first, last = cast(nn.Linear, self.net[0]), self.net[-1]
        for mine, theirs in zip(self.net, other.net, strict=True):
            if mine is not first and (mine is not last or self.action_low.shape == other.action_low.shape):
                mine.load_state_dict(theirs.state_dict())
        if self.observation_mean.shape == other.observation_mean.shape:
            theirs = cast(nn.Linear, other.net[0])
            shift = (self.observation_mean - other.observation_mean) / other.observation_std
            first.weight.copy_(theirs.weight * (self.observation_std / other.observation_std))
            first.bias.copy_(theirs.bias + theirs.weight @ shift)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Observation (..., S) to the mean and log standard deviation, each (..., A), before the tanh."""
        scaled = (observation - self.observation_mean) / self.observation_std
        mean, log_std = self.net(scaled).float().chunk(2, dim=-1)
        return mean, log_std.clamp(self.log_std_min, LOG_STD_MAX)

    def _scale(self, squashed: Tensor) -> Tensor:
        return self.action_low + 0.5 * (squashed + 1.0) * (self.action_high - self.action_low)

    def act(self, observation: Tensor, deterministic: bool = True, generator: torch.Generator | None = None) -> Tensor:
        """Observations (B, S) to actions (B, A): tanh of the mean, or of a sample drawn with `generator`."""
        with torch.no_grad():
            mean, log_std = self(observation)
            if not deterministic:
                mean = mean + log_std.exp() * _normal(mean, generator)
            return self._scale(torch.tanh(mean))

    def sample(
        self, observation: Tensor, count: int | None = None, *, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        """Reparameterised actions and their log-density, per unit of the squashed action in [-1, 1].

        Args:
            observation: (B, S).
            count: actions per observation; None draws one without the extra axis.

        Returns:
            actions (B, A) and log-density (B,), or (B, count, A) and (B, count).
        """
        mean, log_std = self(observation)
        if count is not None:
            mean, log_std = (x.unsqueeze(-2).expand(-1, count, -1) for x in (mean, log_std))
        noise = _normal(mean, generator)
        raw = mean + log_std.exp() * noise
        log_density = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi) - _log_tanh_slope(raw)
        return self._scale(torch.tanh(raw)), log_density.sum(-1)

    def log_prob(self, observation: Tensor, action: Tensor) -> Tensor:
        """Log-density of given actions: observation (B, S), action (B, A) to (B,), per unit of the squashed action."""
        mean, log_std = self(observation)
        squashed = 2.0 * (action - self.action_low) / (self.action_high - self.action_low) - 1.0
        raw = torch.atanh(squashed.clamp(-0.999, 0.999))
        scaled = (raw - mean) * torch.exp(-log_std)
        log_density = -0.5 * scaled.square() - log_std - 0.5 * math.log(2 * math.pi) - _log_tanh_slope(raw)
        return log_density.sum(-1)


def _normal(like: Tensor, generator: torch.Generator | None) -> Tensor:
    return torch.randn(like.shape, generator=generator, dtype=like.dtype, device=like.device)


def _log_tanh_slope(raw: Tensor) -> Tensor:
    """log(1 - tanh(x)^2), written so that it neither overflows nor loses precision for large |x|."""
    return 2.0 * (math.log(2.0) - raw - F.softplus(-2.0 * raw))


class RandomPolicy:
    """Uniform actions in the action space: the `random` tier and the learner's warm-up."""

    def __init__(self, action_low: Tensor, action_high: Tensor) -> None:
        self.action_low, self.action_high = action_low, action_high

    def act(self, observation: Tensor, deterministic: bool = False, generator: torch.Generator | None = None) -> Tensor:
        """Observations (B, S) to uniform actions (B, A); `deterministic` changes nothing: it has no mode to return."""
        size = (len(observation), len(self.action_low))
        uniform = torch.rand(size, generator=generator, device=self.action_low.device)
        return self.action_low + uniform * (self.action_high - self.action_low)


POLICIES = {"tanh_gaussian": TanhGaussianActor}


def save_policy(folder: str | Path, actor: TanhGaussianActor) -> None:
    """Writes an actor as safetensors beside JSON."""
    save_module(folder, actor, kind="tanh_gaussian", arguments=actor.arguments)


def load_policy(folder: str | Path) -> TanhGaussianActor:
    """The policy saved in a folder, ready to `act`.

    Raises:
        UserError: the folder is missing, damaged, or holds something that is not a policy, or one whose action limits
            are no finite range.
    """
    actor = load_module(folder, POLICIES)
    width = actor.action_high - actor.action_low
    if not ((width > 0) & width.isfinite()).all():
        raise UserError(
            f"{folder} holds action limits {actor.action_low.tolist()} and {actor.action_high.tolist()}: each low one "
            "must be less than its high one, and both finite; train the policy on data that say so."
        )
    return actor
