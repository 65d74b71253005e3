"""The actors that policies are: networks from observations to actions, one class a kind."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, ClassVar, TypedDict, Unpack, cast, overload

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn
from torch.nn import functional as F

from envtf_lit.errors import UserError

LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0
FINEST = 1e-3  # error that least squares ask for, of half the actions' range
BOUND = 0.99  # squashed actions of at least this size count as at their bound


def mlp(sizes: Sequence[int], *, layer_norm: bool = False) -> nn.Sequential:
    """Linear layers of these sizes with ReLU (after an optional LayerNorm) between them."""
    layers: list[nn.Module] = []
    for index, (fan_in, fan_out) in enumerate(pairwise(sizes)):
        layers.append(nn.Linear(fan_in, fan_out))
        if index < len(sizes) - 2:
            layers += [nn.LayerNorm(fan_out), nn.ReLU()] if layer_norm else [nn.ReLU()]
    return nn.Sequential(*layers)


def in_fp32(layer: nn.Module, x: Tensor) -> Tensor:
    """A last layer's output in fp32, whatever the precision around it.

    bf16 has eight bits: at a value of 300 its steps are 2, wider than what actions differ by.
    """
    with torch.autocast(x.device.type, enabled=False):
        return layer(x.float())


def in_kind(
    act: Callable[[Tensor], Tensor], observation: Tensor | ArrayLike, device: torch.device
) -> Tensor | np.ndarray:
    """Actions of `act`, which takes tensors in single precision or less, for what was seen, and in its kind.

    A tensor for a tensor, float64 for float64 and else float32; for an array or lists, which are looked at on `device`,
    an array (float32).
    """
    if not isinstance(observation, Tensor):
        return act(torch.from_numpy(np.array(observation, np.float32)).to(device)).cpu().numpy()
    return act(observation.float()).double() if observation.dtype == torch.float64 else act(observation)


class Sizes(TypedDict, total=False):
    """What the constructors of all kinds of actors take by name; see `Actor`."""

    hidden: Sequence[int]
    layer_norm: bool
    action_low: Sequence[float] | None
    action_high: Sequence[float] | None


class Actor(nn.Module, ABC):
    """A network from observations to actions: what the kinds of actors share.

    Observations are z-scored by buffers inside the module, so that a saved actor needs nothing beside it.

    Args:
        observation_dim: S.
        action_dim: A.
        hidden: units of each hidden layer.
        layer_norm: LayerNorm before each ReLU.
        action_low, action_high: (A,), None for [-1, 1].

    Attributes:
        heads: numbers that the network gives for each action dimension.
        arguments: the constructor's, to build the module again.
    """

    heads: ClassVar[int] = 1

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
        action_low: Sequence[float] | None = None,
        action_high: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        self.arguments: dict[str, Any] = dict(
            observation_dim=observation_dim,
            action_dim=action_dim,
            hidden=list(hidden),
            layer_norm=layer_norm,
            action_low=list(action_low) if action_low is not None else None,
            action_high=list(action_high) if action_high is not None else None,
        )
        self.net = mlp([observation_dim, *hidden, self.heads * action_dim], layer_norm=layer_norm)
        self.register_buffer("observation_mean", torch.zeros(observation_dim))
        self.register_buffer("observation_std", torch.ones(observation_dim))
        low = -1.0 if action_low is None else torch.as_tensor(action_low, dtype=torch.float32)
        high = 1.0 if action_high is None else torch.as_tensor(action_high, dtype=torch.float32)
        self.register_buffer("action_low", torch.zeros(action_dim) + low)
        self.register_buffer("action_high", torch.zeros(action_dim) + high)

    @torch.no_grad()
    def start_from(self, other: "Actor") -> None:
        """Takes over another actor's layers; this one keeps its scales, which are those of its own data.

        The hidden layers must be alike. A first layer for observations of the same size is taken over too, rescaled so
        that it sees what it saw; so is a last one for actions of the same size, which then mean the same shares of the
        range. Others begin anew.

        Raises:
            UserError: the actors are of two kinds, or the hidden layers differ.
        """
        if type(other) is not type(self):
            raise UserError(f"it is a {kind_of(other)} actor, and this one is {kind_of(self)}: start from one like it.")
        for name, mine in self.arguments.items():
            if name in ("observation_dim", "action_dim", "action_low", "action_high"):
                continue
            theirs = other.arguments[name]
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

    def outputs(self, observation: Tensor) -> Tensor:
        """Observations (..., S) to what the network says of them (..., heads * A), in fp32.

        Raises:
            UserError: they are not as wide as the actor's.
        """
        if observation.shape[-1:] != self.observation_mean.shape:
            raise UserError(
                f"The policy takes observations of {len(self.observation_mean)} numbers: these have the shape "
                f"{tuple(observation.shape)}."
            )
        x = (observation - self.observation_mean) / self.observation_std
        *hidden, last = self.net
        for layer in hidden:
            x = layer(x)
        return in_fp32(last, x)

    @overload
    def act(
        self, observation: Tensor, deterministic: bool = True, generator: torch.Generator | None = None
    ) -> Tensor: ...

    @overload
    def act(
        self, observation: ArrayLike, deterministic: bool = True, generator: torch.Generator | None = None
    ) -> np.ndarray: ...

    def act(
        self, observation: Tensor | ArrayLike, deterministic: bool = True, generator: torch.Generator | None = None
    ) -> Tensor | np.ndarray:
        """Observations (B, S) to actions (B, A), or one (S,) to one (A,), in the environment's own range.

        A tensor gives a tensor of its precision, without gradient; an array or a list of numbers an array (float32).

        Args:
            observation: what is seen.
            deterministic: the action that the actor would choose, not one that it draws.
            generator: of what is drawn.

        Raises:
            UserError: it is not as wide as the actor's observations.
        """
        with torch.no_grad():
            device = self.observation_mean.device
            return in_kind(lambda given: self._act(given, deterministic, generator), observation, device)

    @abstractmethod
    def _act(self, observation: Tensor, deterministic: bool, generator: torch.Generator | None) -> Tensor:
        """Observations (..., S) to actions (..., A)."""

    @abstractmethod
    def clone_error(self, observation: Tensor, action: Tensor) -> Tensor:
        """(B,) how far the actor is from given actions, per action dimension: what cloning makes small."""

    def _scale(self, squashed: Tensor) -> Tensor:
        return self.action_low + 0.5 * (squashed + 1.0) * (self.action_high - self.action_low)

    def squashed(self, action: Tensor) -> Tensor:
        """The inverse of the last scaling: actions (..., A) as shares of the range, from -1 to 1."""
        return 2.0 * (action - self.action_low) / (self.action_high - self.action_low) - 1.0


class TanhGaussianActor(Actor):
    """`a = tanh(x), x ~ N(mean(s), std(s))`, scaled to the action space (Haarnoja et al. 2018, appendix C)."""

    heads = 2

    def __init__(
        self, observation_dim: int, action_dim: int, *, log_std_min: float = LOG_STD_MIN, **others: Unpack[Sizes]
    ) -> None:
        super().__init__(observation_dim, action_dim, **others)
        self.arguments["log_std_min"] = self.log_std_min = log_std_min

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Observation (..., S) to the mean and log standard deviation, each (..., A), before the tanh."""
        mean, log_std = self.outputs(observation).chunk(2, dim=-1)
        return mean, log_std.clamp(self.log_std_min, LOG_STD_MAX)

    def _act(self, observation: Tensor, deterministic: bool, generator: torch.Generator | None) -> Tensor:
        """Tanh of the mean, or of a draw."""
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
        """Log-likelihood of given actions: observation (B, S), action (B, A) to (B,).

        Log-density per unit of the squashed action; at the bound, where that has no limit, the log-probability of all
        that is squashed beyond it (a censored Gaussian: Tobin 1958), at most zero.
        """
        mean, log_std = self(observation)
        squashed = self.squashed(action)
        raw = torch.atanh(squashed.clamp(-BOUND, BOUND))
        scaled = (raw - mean) * torch.exp(-log_std)
        inside = -0.5 * scaled.square() - log_std - 0.5 * math.log(2 * math.pi) - _log_tanh_slope(raw)
        beyond = torch.special.log_ndtr(-scaled * squashed.sign())
        return torch.where(squashed.abs() < BOUND, inside, beyond).sum(-1)

    def clone_error(self, observation: Tensor, action: Tensor) -> Tensor:
        """(B,) `-log pi(a|s) / A`."""
        return -self.log_prob(observation, action) / action.shape[-1]

    def least_squares(self, observation: Tensor, action: Tensor) -> Tensor:
        """() `log(mean (tanh(mean(s)) - a)^2) / 2`, mean over the dimensions: the likelihood under one spread for all.

        Where states decide actions, no row is worth less than another; a spread that depends on the state says that
        those are which are hardest to fit (Seitzer et al. 2022).
        """
        missed = torch.tanh(self(observation)[0]) - self.squashed(action)
        return 0.5 * missed.square().mean(0).clamp(min=FINEST**2).log().mean()


class GaussianActor(Actor):
    """`u ~ N(tanh(x(s)), std)`, scaled to the action space: a mean within it, one spread for all states, no squashing.

    The policy of IQL (Kostrikov et al. 2021), whose log-density stays bounded where recorded actions lie at their
    limits; a squashed Gaussian's has no bound there.
    """

    def __init__(self, observation_dim: int, action_dim: int, **others: Unpack[Sizes]) -> None:
        super().__init__(observation_dim, action_dim, **others)
        self.log_std = nn.Parameter(torch.zeros(action_dim))

    @torch.no_grad()
    def start_from(self, other: Actor) -> None:
        """As of `Actor`; the spread too, for actions of the same size."""
        super().start_from(other)
        if isinstance(other, GaussianActor) and self.log_std.shape == other.log_std.shape:
            self.log_std.copy_(other.log_std)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Observation (..., S) to the mean (..., A) and log standard deviation (A,), in shares of the range."""
        return torch.tanh(self.outputs(observation)), self.log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)

    def _act(self, observation: Tensor, deterministic: bool, generator: torch.Generator | None) -> Tensor:
        """The mean, or a draw, cut at the limits."""
        mean, log_std = self(observation)
        if not deterministic:
            mean = (mean + log_std.exp() * _normal(mean, generator)).clamp(-1.0, 1.0)
        return self._scale(mean)

    def log_prob(self, observation: Tensor, action: Tensor) -> Tensor:
        """Log-density of given actions: observation (B, S), action (B, A) to (B,), per unit of shares of the range."""
        mean, log_std = self(observation)
        scaled = (self.squashed(action) - mean) * torch.exp(-log_std)
        return (-0.5 * scaled.square() - log_std - 0.5 * math.log(2 * math.pi)).sum(-1)

    def clone_error(self, observation: Tensor, action: Tensor) -> Tensor:
        """(B,) `-log pi(a|s) / A`."""
        return -self.log_prob(observation, action) / action.shape[-1]


class DeterministicActor(Actor):
    """`a = tanh(x(s))`, scaled to the action space: the policy of TD3 and its kin (Fujimoto et al. 2018)."""

    def forward(self, observation: Tensor) -> Tensor:
        """Observations (..., S) to actions (..., A) in the environment's own range."""
        return self._scale(torch.tanh(self.outputs(observation)))

    def _act(self, observation: Tensor, deterministic: bool, generator: torch.Generator | None) -> Tensor:
        """`deterministic` changes nothing: there is nothing to draw."""
        return self(observation)

    def clone_error(self, observation: Tensor, action: Tensor) -> Tensor:
        """(B,) squared distance in shares of the range, mean over action dimensions."""
        return (self.squashed(self(observation)) - self.squashed(action)).square().mean(-1)


def _normal(like: Tensor, generator: torch.Generator | None) -> Tensor:
    return torch.randn(like.shape, generator=generator, dtype=like.dtype, device=like.device)


def _log_tanh_slope(raw: Tensor) -> Tensor:
    """log(1 - tanh(x)^2), written so that it neither overflows nor loses precision for large |x|."""
    return 2.0 * (math.log(2.0) - raw - F.softplus(-2.0 * raw))


POLICIES: dict[str, type[Actor]] = {
    "tanh_gaussian": TanhGaussianActor,
    "gaussian": GaussianActor,
    "deterministic": DeterministicActor,
}


def kind_of(actor: Actor) -> str:
    """The name of an actor's kind, in the registry of all."""
    return next(name for name, cls in POLICIES.items() if cls is type(actor))
