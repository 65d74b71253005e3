"""The world-model interface, all that imagination and evaluation see: a batched simulator, and what it predicts."""

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import torch
from torch import Tensor

Mode = Literal["mean", "sample"]


@dataclass(frozen=True)
class Prediction:
    """Predictive distribution of one step, and an outcome of it, for B rows; in the data's units unless said otherwise.

    Attributes:
        observation: (B, S) next state.
        reward: (B,).
        mean: (B, S + 1) the predictive mean of (next observation, reward).
        aleatoric: (B, S + 1) standard deviation of (next observation, reward) from the data's own noise; with a `tail`,
            of the Gaussian that has the same 90 % interval.
        epistemic: (B, S + 1) standard deviation from lack of data, or None where the model has no such estimate.
        uncertainty: (B,) `||sqrt(S_au + S_eu)||_2 / sqrt(S)` over z-scored live observation dimensions: the penalty u.
        novelty: (B,) epistemic variance as a multiple of its 0.999 quantile over the training data: beyond 1 the model
            has left what it knows. None where the model has no such estimate.
        log_prob: (B,) log-density of (observation, reward) under the predictive distribution; gradients reach the
            distribution alone, not the draw.
        tail: (S + 1,) how heavy the tails of the predictive distribution are (`world_models.tails`); None: Gaussian.
    """

    observation: Tensor
    reward: Tensor
    mean: Tensor
    aleatoric: Tensor
    epistemic: Tensor | None
    uncertainty: Tensor
    novelty: Tensor | None
    log_prob: Tensor
    tail: Tensor | None = None


class WorldModel(Protocol):
    """Interface of a batched, seeded simulator with an explicit state.

    States are consumed: after `step` only the returned state is valid, since caches are written in place.
    """

    observation_dim: int
    action_dim: int

    def init(
        self,
        observations: Tensor,
        actions: Tensor,
        lengths: Tensor,
        window: Tensor | None = None,
        *,
        posterior: float = 0.0,
        generator: torch.Generator | None = None,
    ) -> Any:
        """Starts B rollouts from histories.

        Args:
            observations: (W, T, S) windows of a log, right-padded.
            actions: (W, T - 1, A), right-padded; a rollout's current state has no action yet.
            lengths: (B,) observations of its window that each rollout has seen, 1 to T; the last is its present one.
            window: (B,) the window of each rollout; None where each has one of its own, W = B. Many rollouts that begin
                in one window cost no more reading than one.
            posterior: above zero each rollout runs, from end to end, in a model of its own, drawn from the posterior
                with its deviation from the mean model times this (1: as it is).
            generator: of those draws.

        Raises:
            UserError: `posterior` is above zero and the model has none.
        """
        ...

    def step(
        self, state: Any, action: Tensor, *, mode: Mode = "mean", generator: torch.Generator | None = None
    ) -> tuple[Any, Prediction]:
        """Acts with (B, A) in every row; the next observation is the mean, or a draw with `generator`."""
        ...

    def observe(self, state: Any, observation: Tensor) -> Any:
        """Replaces the current observation (B, S) by what was really seen (teacher forcing, online use)."""
        ...

    def current(self, state: Any) -> Tensor:
        """The current observation (B, S) of a state."""
        ...

    def fork(self, state: Any, n: int) -> Any:
        """Each row n times, in order: row b becomes rows b*n … b*n + n - 1."""
        ...

    def gather(self, state: Any, index: Tensor) -> Any:
        """The rows of these indices (K,), in the order given."""
        ...

    def same_worlds(self, state: Any, former: Any, rows: Tensor) -> Any:
        """A state of `init` in which these rows (B,) bool run in the drawn models that those of `former` ran in.

        For rollouts that are carried on from a history of their own. `former` may have been consumed.
        """
        ...
