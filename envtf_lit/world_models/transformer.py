"""The Environment Transformer: one causal transformer, one token per state-action pair."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from envtf_lit.errors import UserError
from envtf_lit.world_models.attention import Block, _cache_type, _take, rotate, rotation, window_mask
from envtf_lit.world_models.forecast import Trajectories, forecast
from envtf_lit.world_models.interface import Mode, Prediction
from envtf_lit.world_models.normaliser import Normaliser
from envtf_lit.world_models.objectives import beta_nll, nll, paper_mse
from envtf_lit.world_models.options import ModelOptions
from envtf_lit.world_models.uncertainty.laplace import LastLayerLaplace, RandomFeatures, clusters
from envtf_lit.world_models.uncertainty.recalibration import fitted, normal_scores
from envtf_lit.world_models.uncertainty.tails import log_density, stretch

LOG_VARIANCE_MIN, LOG_VARIANCE_MAX = -14.0, 4.0


@dataclass(frozen=True)
class TransformerState:
    """A batch of rollouts under way: the ring cache, the clock, and the state that has no action yet.

    Attributes:
        cache: per layer, keys and values (context, B, H, d), in `_cache_type`; token t lies in slot t mod context, and
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


class EnvironmentTransformer(nn.Module):
    """Predicts next state and reward with aleatoric variance, from up to `context` past state-action pairs.

    Epistemic variance is the posterior of the last layer (`epistemic="laplace"`, zero until `laplace.fit`), or the
    paper's third head. A score of the outcome sees only the sum of the two variances, so how such a head splits it is
    arbitrary; it is there to reproduce the paper.

    Attributes:
        recalibration: (S + 1,) factor of both predicted variances, one until `recalibrate`; the loss knows nothing of
            it.
        tail: (S + 1,) of the predictive distributions, zero, as of Gaussians, until `recalibrate`.

    Raises:
        UserError: `heads` does not divide `width` into even parts, or `paper_mse` lacks its third head.
    """

    recalibration: Tensor
    tail: Tensor

    def __init__(self, observation_dim: int, action_dim: int, **options: Any) -> None:
        super().__init__()
        self.options = ModelOptions(**options)
        width, heads = self.options.width, self.options.heads
        if width % (2 * heads):
            raise UserError(f"width {width} does not split into {heads} heads of even size: choose width = 2k * heads.")
        self.has_epistemic_head = self.options.epistemic == "head"
        if self.options.objective == "paper_mse" and not self.has_epistemic_head:
            raise UserError(
                f"objective is paper_mse, which trains an epistemic head, and epistemic is {self.options.epistemic}: "
                "set it to head."
            )
        self.observation_dim, self.action_dim = observation_dim, action_dim
        self.normaliser = Normaliser(
            observation_dim, action_dim, delta=self.options.target == "delta", bounded=self.options.bounded
        )
        self.embed = nn.Linear(observation_dim + action_dim, width)
        self.blocks = nn.ModuleList(Block(self.options) for _ in range(self.options.layers))
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, (3 if self.has_epistemic_head else 2) * (observation_dim + 1))
        self.register_buffer("recalibration", torch.ones(observation_dim + 1))
        self.register_buffer("tail", torch.zeros(observation_dim + 1))
        self.apply(_initialise)
        for block in self._stack():  # residual branches start small: sum of 2L terms keeps unit scale (GPT-2)
            for weight in (block.attention.out.weight, block.mlp[2].weight):
                nn.init.normal_(cast(Tensor, weight), std=0.02 * (2 * self.options.layers) ** -0.5)
        self.random_features, self.laplace = None, None
        if self.options.epistemic == "laplace":
            count = self.options.random_features
            self.random_features = RandomFeatures(observation_dim + action_dim, count)
            self.laplace = LastLayerLaplace(width, observation_dim + 1, further=count)

    def _stack(self) -> list[Block]:
        return cast(list[Block], list(self.blocks))

    @property
    def arguments(self) -> dict[str, Any]:
        """What the constructor needs to build this module again."""
        return dict(observation_dim=self.observation_dim, action_dim=self.action_dim, **asdict(self.options))

    @torch.no_grad()
    def start_from(self, other: "EnvironmentTransformer") -> None:
        """Takes over another model's weights; this one keeps its normaliser, which knows its own data.

        The blocks must be alike. A projection of the same dimensions is taken over too, rescaled so that in the data's
        own units the model predicts what the other does (variances as far as their bounds let them); others, such as
        those of another robot, begin anew. So do posterior, recalibration and tail.

        Raises:
            UserError: the two differ in what the weights mean.
        """
        mine, theirs = asdict(self.options), asdict(other.options)
        for name in ("layers", "heads", "width", "activation", "target"):
            if mine[name] != theirs[name]:
                raise UserError(f"{name} is {theirs[name]} there and {mine[name]} here; leave it as it is there.")
        for part in ("blocks", "norm"):
            getattr(self, part).load_state_dict(getattr(other, part).state_dict())
        if self.observation_dim != other.observation_dim:
            return
        if self.action_dim == other.action_dim:
            (old_mean, old_std), (mean, std) = other.normaliser.input_scale(), self.normaliser.input_scale()
            self.embed.weight.copy_(other.embed.weight * (std / old_std))
            self.embed.bias.copy_(other.embed.bias + other.embed.weight @ ((mean - old_mean) / old_std))
        if self.head.weight.shape == other.head.weight.shape:
            self._take_over_head(other)

    def _take_over_head(self, other: "EnvironmentTransformer") -> None:
        old, new = other.normaliser, self.normaliser
        ratio = old.target_std / new.target_std  # (S + 1,)
        weights, biases = other.head.weight.split(len(ratio)), other.head.bias.split(len(ratio))
        mean = biases[0] * ratio + (old.target_mean - new.target_mean) / new.target_std
        self.head.weight.copy_(torch.cat([weights[0] * ratio[:, None], *weights[1:]]))
        self.head.bias.copy_(torch.cat([mean, *(bias + 2 * ratio.log() for bias in biases[1:])]))

    def forward(self, observations: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Whole sequences (B, T, S) and (B, T, A) to mean, log-variance and epistemic log-variance, (B, T, S + 1).

        All in the unit scale of `normaliser.target`. Rows of different length are padded on the right: no token sees
        what comes after it.
        """
        hidden, _ = self.encode(observations, actions, cached=False)
        return self.heads(hidden)

    def encode(
        self, observations: Tensor, actions: Tensor, *, cached: bool
    ) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
        """Last hidden tokens (B, T, D) and, if `cached`, each layer's keys and values (B, H, T, d)."""
        T = observations.shape[1]
        mask = window_mask(T, self.options.context, observations.device) if T > self.options.context else None
        cos_sin = self._rotation(torch.arange(T, device=observations.device))
        x = self.embed(self.normaliser.token(observations, actions))
        cache = []
        for block in self._stack():
            q, k, v = block.attention.project(block.attention_norm(x), cos_sin)
            if cached:
                cache.append((k, v))
            x = block.finish(x, block.attention(q, k, v, mask))
        return self.norm(x), cache

    def _rotation(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        return rotation(positions, self.options.width // self.options.heads)

    def heads(self, hidden: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Hidden tokens (..., D) to mean, log-variance, epistemic log-variance or None, each (..., S + 1), in fp32."""
        with torch.autocast(hidden.device.type, enabled=False):
            mean, *log_variances = self.head(hidden.float()).chunk(3 if self.has_epistemic_head else 2, dim=-1)
        bounded = [_bound(x) for x in log_variances]
        return mean, bounded[0], bounded[1] if self.has_epistemic_head else None

    def loss(self, batch: dict[str, Tensor], *, generator: torch.Generator | None = None) -> Tensor:
        """Mean objective per valid token and output dimension of a batch of windows (see `data.loaders.Windows`)."""
        mean, log_variance, epistemic = self(batch["observations"], batch["actions"])
        target = self.normaliser.target(batch["observations"], batch["next_observations"], batch["rewards"])
        if self.options.objective == "paper_mse":
            assert epistemic is not None
            loss = paper_mse(mean, log_variance, epistemic, target, generator=generator)
        else:
            if epistemic is not None:
                log_variance = torch.logaddexp(log_variance, epistemic)
            loss = {"nll": nll, "beta_nll": beta_nll}[self.options.objective](mean, log_variance, target)
        return (loss * batch["mask"]).sum() / (batch["mask"].sum() * target.shape[-1])

    @torch.no_grad()
    def fit_epistemic(self, batches: Iterable[dict[str, Tensor]], *, generator: torch.Generator) -> None:
        """Fits the last layer's posterior to the valid tokens of training windows; nothing to do without one.

        Args:
            batches: as `loss` takes them.
            generator: of the clusters of (s, a) that set the posterior's scale, and of random features.
        """
        if self.laplace is None or self.random_features is None:
            return
        parts = []
        for batch in batches:
            batch = {name: column.to(self.head.weight.device) for name, column in batch.items()}
            valid = batch["mask"].bool()
            hidden, _ = self.encode(batch["observations"], batch["actions"], cached=False)
            target = self.normaliser.target(batch["observations"], batch["next_observations"], batch["rewards"])
            token = self.normaliser.token(batch["observations"], batch["actions"])
            parts.append([column[valid] for column in (hidden.float(), target, token)])
        hidden, target, token = (torch.cat(columns) for columns in zip(*parts, strict=True))
        del parts
        groups = clusters(token, generator)
        self.random_features.fit(token, generator)
        mean, log_variance, _ = self.heads(hidden)
        self.laplace.fit(self.posterior_inputs(hidden, token), target, mean, log_variance.exp(), groups)

    def posterior_inputs(self, hidden: Tensor, token: Tensor) -> Tensor:
        """(..., P) what the posterior sees of hidden tokens (..., D) and the pairs (..., S + A) they end in."""
        assert self.random_features is not None
        return torch.cat([hidden.float(), self.random_features(token)], -1)

    def recalibrate(self, trajectories: Trajectories) -> None:
        """Fits `recalibration` and `tail` to episodes kept out of training.

        Not of the paper's objective, whose collapsed variances are what it is there to show.
        """
        if self.options.objective == "paper_mse":
            return
        self.recalibration.fill_(1.0)
        self.tail.zero_()
        trajectories = trajectories.to(self.recalibration.device)
        factor, tail = fitted(normal_scores(forecast(self, trajectories, feedback="recorded"), trajectories))
        self.recalibration.copy_(factor)
        self.tail.copy_(tail)

    def init(
        self,
        observations: Tensor,
        actions: Tensor,
        lengths: Tensor,
        window: Tensor | None = None,
        *,
        posterior: float = 0.0,
        generator: torch.Generator | None = None,
    ) -> TransformerState:
        """See `WorldModel.init`. One causal pass over the windows serves all rollouts that begin in them."""
        B, longest = len(lengths), observations.shape[1] - 1  # rollouts, and tokens of a history
        window = torch.arange(B, device=lengths.device) if window is None else window
        current = observations[window, lengths - 1]
        clock = min(longest, self.options.context - 1)  # all rows' tokens before the current states lie in one slot
        size = (self.options.context, B, self.options.heads, self.options.width // self.options.heads)
        kind = _cache_type(current.device)
        cache = [(current.new_empty(size, dtype=kind), current.new_empty(size, dtype=kind)) for _ in self.blocks]
        first = None
        if clock > 0:
            shift = clock - (lengths - 1)  # (B,) from a token's position in the window to that in the cache
            index = torch.arange(clock, device=shift.device)[:, None] - shift  # (clock, B)
            first = shift.clamp(min=0) if bool((shift > 0).any()) else None
            _, tokens = self.encode(observations[:, :-1], actions, cached=True)
            for (keys, values), (k, v) in zip(cache, tokens, strict=True):
                k, v = (x.transpose(1, 2)[window, index.clamp(min=0)] for x in (k, v))  # (clock, B, H, d)
                keys[:clock], values[:clock] = rotate(k.float(), self._rotation(shift[:, None])), v
        drawn = posterior * self._posterior().draw(B, generator) if posterior > 0 else None
        return TransformerState(cache, clock, first, current, drawn)

    def _posterior(self) -> LastLayerLaplace:
        if self.laplace is None:
            raise UserError(
                "This world model has no posterior to draw from, since it was trained with epistemic: "
                f"{self.options.epistemic}: set posterior to 0, or train one with epistemic: laplace."
            )
        return self.laplace

    def step(
        self,
        state: TransformerState,
        action: Tensor,
        *,
        mode: Mode = "mean",
        generator: torch.Generator | None = None,
    ) -> tuple[TransformerState, Prediction]:
        """See `WorldModel.step`. One token per call; the cache is written in place unless gradients are needed."""
        token = self.normaliser.token(state.observation, action)
        x = self.embed(token)  # (B, D)
        mask = self._visible(state, min(state.clock + 1, self.options.context))
        cos_sin = self._rotation(torch.full((1,), state.clock, device=x.device))
        cache = []
        for block, (keys, values) in zip(self._stack(), state.cache, strict=True):
            x, keys, values = block.advance(x, keys, values, mask, state.clock, cos_sin)
            cache.append((keys, values))
        last = self.norm(x), token, state.observation
        prediction = self.predict(*last, state.drawn, mode=mode, generator=generator)
        return TransformerState(cache, state.clock + 1, state.first, prediction.observation, state.drawn), prediction

    def fuse(self) -> None:
        """Lets `step` run through torch.compile from now on: by blocks, which are alike, so that one serves all."""
        for block in self._stack():
            block.advance = torch.compile(block.advance, dynamic=True)  # the clock and the number of rows change
        self.predict = torch.compile(self.predict, dynamic=True)

    def _visible(self, state: TransformerState, filled: int) -> Tensor | None:
        """(C, B, 1), which of the filled slots hold a token of the row itself; None where all do."""
        if state.first is None:
            return None
        slot = torch.arange(filled, device=state.observation.device)
        position = state.clock - (state.clock - slot) % self.options.context
        return (position[:, None] >= state.first)[..., None]

    def predict(
        self,
        hidden: Tensor,
        token: Tensor,
        observation: Tensor,
        drawn: Tensor | None = None,
        *,
        mode: Mode = "mean",
        generator: torch.Generator | None = None,
    ) -> Prediction:
        """Last hidden tokens (..., D) of pairs (..., S + A), as normalised, in states (..., S), to a `Prediction`.

        With drawn last layers (B, D + 1, S + 1) outcomes follow those, and differ by aleatoric noise alone; `log_prob`
        is under the whole distribution nevertheless.
        """
        scale = self.normaliser.target_std
        mean, log_variance, epistemic_log_variance = self.heads(hidden)
        epistemic, novelty = None, None
        if epistemic_log_variance is not None:
            epistemic = epistemic_log_variance.exp()
        elif self.laplace is not None:
            leverage = self.laplace.leverage(self.posterior_inputs(hidden, token))
            epistemic, novelty = self.laplace.variance(leverage), leverage / self.laplace.limit
        aleatoric = log_variance.exp() * self.recalibration
        epistemic = None if epistemic is None else epistemic * self.recalibration
        variance = aleatoric if epistemic is None else aleatoric + epistemic
        value, spread = mean, variance
        if drawn is not None:
            deviation = self._posterior().deviation(hidden.float(), drawn)
            value, spread = mean + deviation * self.recalibration.sqrt(), aleatoric
        if mode == "sample":
            noise = stretch(torch.empty_like(mean).normal_(generator=generator), self.tail)
            value = value + spread.sqrt() * noise
        std = variance.sqrt()
        density = log_density((value.detach() - mean) / std, self.tail) - (std * scale).log()  # of each output
        outcome = self.normaliser.outcome(observation, value)
        return Prediction(
            observation=outcome[..., :-1],
            reward=outcome[..., -1],
            mean=self.normaliser.outcome(observation, mean),
            aleatoric=aleatoric.sqrt() * scale,
            epistemic=None if epistemic is None else epistemic.sqrt() * scale,
            uncertainty=self.normaliser.uncertainty(variance),
            novelty=novelty,
            log_prob=density.sum(-1),
            tail=self.tail,
        )

    def observe(self, state: TransformerState, observation: Tensor) -> TransformerState:
        """See `WorldModel.observe`."""
        return replace(state, observation=observation)

    def current(self, state: TransformerState) -> Tensor:
        """See `WorldModel.current`."""
        return state.observation

    def fork(self, state: TransformerState, n: int) -> TransformerState:
        """See `WorldModel.fork`."""
        index = torch.arange(len(state.observation), device=state.observation.device).repeat_interleave(n)
        return self.gather(state, index)

    def gather(self, state: TransformerState, index: Tensor) -> TransformerState:
        """See `WorldModel.gather`."""
        filled = min(state.clock, self.options.context)
        cache = [(_take(keys, index, filled), _take(values, index, filled)) for keys, values in state.cache]
        first = None if state.first is None else state.first[index]
        drawn = None if state.drawn is None else state.drawn[index]
        return TransformerState(cache, state.clock, first, state.observation[index], drawn)


def _initialise(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.normal_(module.weight, std=0.02)
        nn.init.zeros_(module.bias)


def _bound(log_variance: Tensor) -> Tensor:
    """Softly clamps to [LOG_VARIANCE_MIN, LOG_VARIANCE_MAX], with a gradient everywhere (Chua et al. 2018)."""
    upper = LOG_VARIANCE_MAX - F.softplus(LOG_VARIANCE_MAX - log_variance)
    return LOG_VARIANCE_MIN + F.softplus(upper - LOG_VARIANCE_MIN)
