"""The probabilistic ensemble of MBPO, MOPO, COMBO and RAMBO (Chua et al. 2018), as one network with a member axis.

Each member is a Gaussian multilayer perceptron of its own; all of them run in one batched product per layer. The
elites, those of least held-out error, predict together: their mixture is the predictive distribution. Where the means
of all members disagree, data were lacking.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn
from torch.nn import functional as F

from envtf_lit.errors import UserError
from envtf_lit.world_models.interface import Mode, Prediction, as_histories, as_rows
from envtf_lit.world_models.normaliser import Normaliser
from envtf_lit.world_models.objectives import nll
from envtf_lit.world_models.uncertainty.laplace import OUTSIDE, quantile

LOG_VARIANCE_BOUNDS = -10.0, 0.5  # where the learned bounds start
BOUND_WEIGHT = 0.01  # of the term that draws the bounds together


@dataclass(frozen=True)
class EnsembleState:
    """State of a batch of B rollouts; the members keep no history.

    Attributes:
        observation: (B, S) current observation.
        drawn: (B,) which elite each row follows from end to end, or None where a draw takes one anew at every step.
        posterior: how far the rows follow it: 1 all the way, 0.5 half the way from the elites' mean.
    """

    observation: Tensor
    drawn: Tensor | None = None
    posterior: float = 0.0


class EnsembleDynamics(nn.Module):
    """World model without memory: predicts next state and reward from the current state and action alone.

    Mean and aleatoric variance are the elites' means of both. Epistemic variance is that of all members' means: where
    data were lacking the worse ones disagree as well as the better ones. One member alone has no such estimate.

    Attributes:
        elite: (E,) int64, numbers of the members that predict.
        limit: the 0.999 quantile over the training data of the epistemic variance, z-scored, mean over live dimensions.

    Raises:
        UserError: there are fewer members than elites.
    """

    elite: Tensor
    limit: Tensor

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        members: int = 7,
        elites: int = 5,
        hidden: Sequence[int] = (200, 200, 200, 200),
    ) -> None:
        super().__init__()
        if not 1 <= elites <= members:
            raise UserError(f"An ensemble of {members} has no {elites} elites: take from 1 to {members}.")
        self.arguments = dict(
            observation_dim=observation_dim, action_dim=action_dim, members=members, elites=elites, hidden=list(hidden)
        )
        self.observation_dim, self.action_dim, self.members = observation_dim, action_dim, members
        self.normaliser = Normaliser(observation_dim, action_dim, delta=True)
        sizes = (observation_dim + action_dim, *hidden, 2 * (observation_dim + 1))
        self.weights = nn.ParameterList(torch.empty(members, a, b) for a, b in itertools.pairwise(sizes))
        self.biases = nn.ParameterList(torch.zeros(members, 1, size) for size in sizes[1:])
        for weight in self.weights:  # MBPO's
            std = 0.5 * weight.shape[1] ** -0.5
            nn.init.trunc_normal_(weight, std=std, a=-2 * std, b=2 * std)
        low, high = LOG_VARIANCE_BOUNDS
        self.log_variance_min = nn.Parameter(torch.full((members, 1, observation_dim + 1), low))
        self.log_variance_max = nn.Parameter(torch.full((members, 1, observation_dim + 1), high))
        self.register_buffer("elite", torch.arange(elites))
        self.register_buffer("limit", torch.ones(()))

    def forward(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Means and log-variances (M, N, S + 1), in the unit scale of `normaliser.target`.

        Args:
            tokens: normalised inputs of each member (M, N, S + A), or of all (N, S + A).
        """
        x = tokens if tokens.dim() == 3 else tokens.expand(self.members, *tokens.shape)
        *layers, (weight, bias) = zip(self.weights, self.biases, strict=True)
        for w, b in layers:
            x = F.silu(torch.baddbmm(b, x, w))  # (M, N, width)
        with torch.autocast(x.device.type, enabled=False):
            mean, log_variance = torch.baddbmm(bias, x.float(), weight).chunk(2, dim=-1)
        high, low = self.log_variance_max, self.log_variance_min
        log_variance = high - F.softplus(high - log_variance)
        return mean, low + F.softplus(log_variance - low)

    def loss(self, batch: dict[str, Tensor]) -> Tensor:
        """Mean Gaussian objective per valid row and output dimension, and the bounds' own term; summed over members.

        Args:
            batch: columns (M, B, T, …), each member's own rows, or (B, T, …), the same for all.
        """
        mean, log_variance, target, valid = self._compare(batch)
        objective = (mean - target).square() * torch.exp(-log_variance) + log_variance
        fit = (objective * valid).sum((1, 2)) / (valid.sum((-2, -1)) * mean.shape[-1])  # (M,)
        return fit.sum() + BOUND_WEIGHT * (self.log_variance_max - self.log_variance_min).sum()

    def decay(self, rates: Sequence[float]) -> Tensor:
        """`sum over layers of rate / 2 * ||weights||^2`, a rate for each layer, the output layer last."""
        return sum(
            (0.5 * rate * w.square().sum() for rate, w in zip(rates, self.weights, strict=True)), torch.zeros(())
        )

    @torch.no_grad()
    def squared_error(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Each member's squared error summed over the valid entries of a batch, (M,), and the number of entries."""
        mean, _, target, valid = self._compare(batch)
        return ((mean - target).square() * valid).sum((1, 2)), valid.sum() * mean.shape[-1]

    def _compare(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Means, log-variances (M, N, S + 1), targets and which rows are valid, windows laid end to end: N = B * T."""
        observations, actions = batch["observations"].flatten(-3, -2), batch["actions"].flatten(-3, -2)
        following, rewards = batch["next_observations"].flatten(-3, -2), batch["rewards"].flatten(-2, -1)
        mean, log_variance = self(self.normaliser.token(observations, actions))
        target = self.normaliser.target(observations, following, rewards)
        return mean, log_variance, target, batch["mask"].flatten(-2, -1)[..., None]

    def adopt(self, other: "EnsembleDynamics", members: Tensor) -> None:
        """Takes over the weights of those members (M,) bool of an ensemble of the same shape."""
        with torch.no_grad():
            for mine, theirs in zip(self.parameters(), other.parameters(), strict=True):
                mine[members] = theirs[members]

    @torch.no_grad()
    def fit_epistemic(self, batches: Iterable[dict[str, Tensor]], *, generator: torch.Generator) -> None:
        """Takes the limit of novelty from training windows; nothing to do for one member.

        Args:
            batches: as `loss` takes them.
            generator: not needed here: only the transformer's posterior draws anything.
        """
        if self.members == 1:
            return
        spreads = []
        for batch in batches:
            batch = {name: column.to(self.limit.device) for name, column in batch.items()}
            valid = batch["mask"].bool()
            tokens = self.normaliser.token(batch["observations"], batch["actions"])[valid]
            epistemic = self(tokens)[0].var(0, correction=0)
            spreads.append(self.normaliser.uncertainty(epistemic).square())
        self.limit.copy_(quantile(torch.cat(spreads), OUTSIDE))

    def init(
        self,
        observations: Tensor | ArrayLike,
        actions: Tensor | ArrayLike,
        lengths: Tensor | ArrayLike,
        window: Tensor | None = None,
        *,
        posterior: float = 0.0,
        generator: torch.Generator | None = None,
    ) -> EnsembleState:
        """See `WorldModel.init`; arrays and lists will do, too. Of the histories only the current observation counts.

        Raises:
            UserError: as of `as_histories`.
        """
        given = observations, actions, lengths, window
        sizes, device = (self.observation_dim, self.action_dim), self.limit.device
        observations, _, lengths, window = as_histories(*given, sizes, device)
        current = observations[window, lengths - 1]
        if posterior <= 0:
            return EnsembleState(current)
        if len(self.elite) == 1:
            raise UserError("This world model has no posterior to draw from, since one member predicts alone.")
        return EnsembleState(current, self._draw(len(lengths), generator), posterior)

    def _draw(self, count: int, generator: torch.Generator | None) -> Tensor:
        return self.elite.new_empty(count).random_(len(self.elite), generator=generator)

    def step(
        self,
        state: EnsembleState,
        action: Tensor | ArrayLike,
        *,
        mode: Mode = "mean",
        generator: torch.Generator | None = None,
    ) -> tuple[EnsembleState, Prediction]:
        """See `WorldModel.step`; an array or a list will do, too.

        A sample follows one elite, drawn for each row at each step unless the row has one.

        Raises:
            UserError: the actions have another shape than (B, A).
        """
        rows = as_rows("actions", action, (len(state.observation), self.action_dim), state.observation.device)

        def value(means: Tensor, log_variances: Tensor) -> Tensor:
            return self._value(state, means, log_variances, mode, generator)

        prediction = self.predict(state.observation, rows, value)
        return replace(state, observation=prediction.observation), prediction

    def predict(self, observation: Tensor, action: Tensor, value: Callable[[Tensor, Tensor], Tensor]) -> Prediction:
        """Observations (B, S) and actions (B, A) to a `Prediction`.

        Args:
            observation: acted upon.
            action: taken.
            value: the elites' means and log-variances (E, B, S + 1) to the outcome (B, S + 1), all in unit scale.
        """
        outputs = self(self.normaliser.token(observation, action))  # each (M, B, S + 1)
        epistemic = outputs[0].var(0, correction=0) if self.members > 1 else None
        means, log_variances = (output[self.elite] for output in outputs)  # (E, B, S + 1)
        mean, aleatoric = means.mean(0), log_variances.exp().mean(0)
        variance = aleatoric if epistemic is None else aleatoric + epistemic
        chosen = value(means, log_variances)
        outcome, scale = self.normaliser.outcome(observation, chosen), self.normaliser.target_std
        density = -nll(means, log_variances, chosen.detach())  # (E, B)
        return Prediction(
            observation=outcome[..., :-1],
            reward=outcome[..., -1],
            mean=self.normaliser.outcome(observation, mean),
            aleatoric=aleatoric.sqrt() * scale,
            epistemic=None if epistemic is None else epistemic.sqrt() * scale,
            uncertainty=self.normaliser.uncertainty(variance),
            novelty=None if epistemic is None else self.normaliser.uncertainty(epistemic).square() / self.limit,
            log_prob=density.logsumexp(0) - math.log(len(means)) - scale.log().sum(),
        )

    def _value(
        self,
        state: EnsembleState,
        means: Tensor,
        log_variances: Tensor,
        mode: Mode,
        generator: torch.Generator | None,
    ) -> Tensor:
        """The outcome (B, S + 1) in unit scale: the mean or a draw, of the mixture or of each row's own elite."""
        B = means.shape[1]
        drawn, value = state.drawn, means.mean(0)
        if drawn is None and mode == "sample":
            drawn = self._draw(B, generator)
        if drawn is None:
            return value
        rows = torch.arange(B, device=drawn.device)
        own = means[drawn, rows]
        value = own if state.drawn is None else value + state.posterior * (own - value)
        if mode == "sample":
            noise = torch.empty_like(value).normal_(generator=generator)
            value = value + torch.exp(0.5 * log_variances[drawn, rows]) * noise
        return value

    @torch.no_grad()
    def largest_deviation(self, observation: Tensor, action: Tensor) -> Tensor:
        """MOPO's u: (N, S) and (N, A) to (N,), the largest norm of any member's standard deviation, in raw units.

        Of next state and reward; of all members, the elites or not (Yu et al. 2020, section 4.3).
        """
        _, log_variances = self(self.normaliser.token(observation, action))  # (M, N, S + 1)
        return (torch.exp(0.5 * log_variances) * self.normaliser.target_std).norm(dim=-1).amax(0)

    def fuse(self) -> None:
        """Lets `step` run through torch.compile from now on."""
        self.step = torch.compile(self.step, dynamic=True)  # the number of rows changes

    def observe(self, state: EnsembleState, observation: Tensor | ArrayLike) -> EnsembleState:
        """See `WorldModel.observe`; an array or a list will do, too.

        Raises:
            UserError: it has another shape than (B, S).
        """
        now = state.observation
        return replace(state, observation=as_rows("observations", observation, (*now.shape,), now.device))

    def current(self, state: EnsembleState) -> Tensor:
        """See `WorldModel.current`."""
        return state.observation

    def fork(self, state: EnsembleState, n: int) -> EnsembleState:
        """See `WorldModel.fork`."""
        index = torch.arange(len(state.observation), device=state.observation.device).repeat_interleave(n)
        return self.gather(state, index)

    def gather(self, state: EnsembleState, index: Tensor) -> EnsembleState:
        """See `WorldModel.gather`."""
        drawn = None if state.drawn is None else state.drawn[index]
        return replace(state, observation=state.observation[index], drawn=drawn)

    def same_worlds(self, state: EnsembleState, former: EnsembleState, rows: Tensor) -> EnsembleState:
        """See `WorldModel.same_worlds`."""
        if state.drawn is None or former.drawn is None:
            return state
        return replace(state, drawn=torch.where(rows, former.drawn, state.drawn))
