"""The Environment Transformer: a causal transformer over state-action pairs, one token per pair.

    x_t = W_e [s_t, a_t] + b_e                      the pair, z-scored
    h_t = norm(blocks(x_{t - context + 1}, …, x_t))
    mu_t, log S_au_t = W_h h_t + b_h                of the state's change and the reward, in unit scale
    s_{t+1}, r_t ~ N(mu_t, S_au_t + S_eu_t)         back in the data's units; after `recalibrate` with a tail

S_au is the aleatoric variance; the epistemic one, S_eu, comes from the posterior of W_h.
"""

from collections.abc import Iterable
from dataclasses import asdict, replace
from typing import Any, cast

import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn
from torch.nn import functional as F

from envtf_lit.errors import UserError
from envtf_lit.world_models.attention import Block, rotation, window_mask
from envtf_lit.world_models.cache import TransformerState
from envtf_lit.world_models.forecast import Trajectories, forecast
from envtf_lit.world_models.interface import Mode, Prediction, as_histories, as_rows
from envtf_lit.world_models.normaliser import Normaliser
from envtf_lit.world_models.objectives import beta_nll, nll, paper_mse
from envtf_lit.world_models.options import ModelOptions
from envtf_lit.world_models.uncertainty.laplace import LastLayerLaplace, RandomFeatures, clusters
from envtf_lit.world_models.uncertainty.recalibration import fitted_factor_and_tail, normal_scores
from envtf_lit.world_models.uncertainty.tails import log_density, stretch

LOG_VARIANCE_MIN, LOG_VARIANCE_MAX = -14.0, 4.0


class EnvironmentTransformer(nn.Module):
    """World model that predicts next state and reward, with their variances, from the last `context` pairs.

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

    def predict(
        self,
        hidden: Tensor,
        token: Tensor,
        observation: Tensor,
        drawn: Tensor | None = None,
        *,
        mode: Mode = "mean",
        generator: torch.Generator | None = None,
        noise: Tensor | None = None,
    ) -> Prediction:
        """Last hidden tokens (..., D) of pairs (..., S + A), as normalised, in states (..., S), to a `Prediction`.

        With drawn last layers (B, D + 1, S + 1) outcomes follow those, and differ by aleatoric noise alone; `log_prob`
        is under the whole distribution nevertheless. Standard normal `noise` (..., S + 1) stands in for a sample's.
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
        if mode == "sample" and noise is None:
            noise = torch.empty_like(mean).normal_(generator=generator)
        if noise is not None:
            value = value + spread.sqrt() * stretch(noise, self.tail)
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

    def posterior_inputs(self, hidden: Tensor, token: Tensor) -> Tensor:
        """(..., P) what the posterior sees of hidden tokens (..., D) and the pairs (..., S + A) they end in."""
        assert self.random_features is not None
        return torch.cat([hidden.float(), self.random_features(token)], -1)

    def _posterior(self) -> LastLayerLaplace:
        if self.laplace is None:
            raise UserError(
                "This world model has no posterior to draw from, since it was trained with epistemic: "
                f"{self.options.epistemic}: set posterior to 0, or train one with epistemic: laplace."
            )
        return self.laplace

    def init(
        self,
        observations: Tensor | ArrayLike,
        actions: Tensor | ArrayLike,
        lengths: Tensor | ArrayLike,
        window: Tensor | None = None,
        *,
        posterior: float = 0.0,
        generator: torch.Generator | None = None,
    ) -> TransformerState:
        """See `WorldModel.init`; arrays and lists will do, too.

        One causal pass over the windows serves all rollouts that begin in them.

        Raises:
            UserError: as of `as_histories`.
        """
        given = observations, actions, lengths, window
        sizes, device = (self.observation_dim, self.action_dim), self.tail.device
        observations, actions, lengths, window = as_histories(*given, sizes, device)
        drawn = posterior * self._posterior().draw(len(lengths), generator) if posterior > 0 else None
        state = TransformerState.empty(self.options, observations[window, lengths - 1], drawn)
        if observations.shape[1] == 1 or self.options.context == 1:
            return state
        _, tokens = self.encode(observations[:, :-1], actions, cached=True)
        return state.with_history(tokens, window, lengths)

    def step(
        self,
        state: TransformerState,
        action: Tensor | ArrayLike,
        *,
        mode: Mode = "mean",
        generator: torch.Generator | None = None,
    ) -> tuple[TransformerState, Prediction]:
        """See `WorldModel.step`; an array or a list will do, too.

        One token per call; the cache is written in place unless gradients are needed.

        Raises:
            UserError: the actions have another shape than (B, A).
        """
        action = as_rows("actions", action, (len(state.observation), self.action_dim), state.observation.device)
        token = self.normaliser.token(state.observation, action)
        x = self.embed(token)  # (B, D)
        mask = state.visible()
        cos_sin = self._rotation(torch.full((1,), state.clock, device=x.device))
        cache = []
        for block, (keys, values) in zip(self._stack(), state.cache, strict=True):
            x, keys, values = block.advance(x, keys, values, mask, state.clock, cos_sin)
            cache.append((keys, values))
        last = self.norm(x), token, state.observation
        prediction = self.predict(*last, state.drawn, mode=mode, generator=generator)
        return TransformerState(cache, state.clock + 1, state.first, prediction.observation, state.drawn), prediction

    def observe(self, state: TransformerState, observation: Tensor | ArrayLike) -> TransformerState:
        """See `WorldModel.observe`; an array or a list will do, too.

        Raises:
            UserError: it has another shape than (B, S).
        """
        now = state.observation
        return replace(state, observation=as_rows("observations", observation, (*now.shape,), now.device))

    def current(self, state: TransformerState) -> Tensor:
        """See `WorldModel.current`."""
        return state.observation

    def fork(self, state: TransformerState, n: int) -> TransformerState:
        """See `WorldModel.fork`."""
        index = torch.arange(len(state.observation), device=state.observation.device).repeat_interleave(n)
        return state.gather(index)

    def gather(self, state: TransformerState, index: Tensor) -> TransformerState:
        """See `WorldModel.gather`."""
        return state.gather(index)

    def same_worlds(self, state: TransformerState, former: TransformerState, rows: Tensor) -> TransformerState:
        """See `WorldModel.same_worlds`."""
        if state.drawn is None or former.drawn is None:
            return state
        return replace(state, drawn=torch.where(rows[:, None, None], former.drawn, state.drawn))

    def fuse(self) -> None:
        """Lets `step` run through torch.compile from now on: by blocks, which are alike, so that one serves all."""
        for block in self._stack():
            block.advance = torch.compile(block.advance, dynamic=True)  # the clock and the number of rows change
        self.predict = torch.compile(self.predict, dynamic=True)

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

    def recalibrate(self, trajectories: Trajectories) -> None:
        """Fits `recalibration` and `tail` to episodes kept out of training.

        Not of the paper's objective, whose collapsed variances are what it is there to show.
        """
        if self.options.objective == "paper_mse":
            return
        self.recalibration.fill_(1.0)
        self.tail.zero_()
        trajectories = trajectories.to(self.recalibration.device)
        factor, tail = fitted_factor_and_tail(
            normal_scores(forecast(self, trajectories, feedback="recorded"), trajectories)
        )
        self.recalibration.copy_(factor)
        self.tail.copy_(tail)


def _initialise(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.normal_(module.weight, std=0.02)
        nn.init.zeros_(module.bias)


def _bound(log_variance: Tensor) -> Tensor:
    """Softly clamps to [LOG_VARIANCE_MIN, LOG_VARIANCE_MAX], with a gradient everywhere (Chua et al. 2018)."""
    upper = LOG_VARIANCE_MAX - F.softplus(LOG_VARIANCE_MAX - log_variance)
    return LOG_VARIANCE_MIN + F.softplus(upper - LOG_VARIANCE_MIN)
