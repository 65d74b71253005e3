"""The z-scoring of a world model's inputs and targets: buffers of the model, saved with it."""

import math

import torch
from torch import Tensor, nn

from envtf_lit.data.dataset import OfflineDataset

MARGIN = 0.1  # of a range, by which bounded outcomes may leave it


class Normaliser(nn.Module):
    """Z-scores of observations, actions and targets.

    Targets are (S + 1): the state's change (`delta`) or the next state (`absolute`), then the reward, each over its own
    standard deviation. Constant dimensions have the scale of `Moments.scale`; constant observations are not live.

    Args:
        observation_dim: S.
        action_dim: A.
        delta: says which targets.
        bounded: outcomes stay within the range of those in the training data, widened at either end by `MARGIN` of it.
    """

    observation_mean: Tensor
    observation_std: Tensor
    action_mean: Tensor
    action_std: Tensor
    target_mean: Tensor
    target_std: Tensor
    live: Tensor
    outcome_low: Tensor
    outcome_high: Tensor

    def __init__(self, observation_dim: int, action_dim: int, *, delta: bool, bounded: bool = False) -> None:
        super().__init__()
        self.delta, self.bounded = delta, bounded
        for name, size in (("observation", observation_dim), ("action", action_dim), ("target", observation_dim + 1)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))
        self.register_buffer("live", torch.ones(observation_dim, dtype=torch.bool))
        if bounded:
            self.register_buffer("outcome_low", torch.full((observation_dim + 1,), -torch.inf))
            self.register_buffer("outcome_high", torch.full((observation_dim + 1,), torch.inf))

    def fit(self, dataset: OfflineDataset) -> None:
        """Takes means and standard deviations, and the bounds if it has any, from the training rows."""
        data = dataset.statistics
        targets = data.changes if self.delta else data.outcomes
        for name, found in (("observation", data.observations), ("action", data.actions), ("target", targets)):
            getattr(self, f"{name}_mean").copy_(found.mean)
            getattr(self, f"{name}_std").copy_(found.scale)
        self.live.copy_(data.observations.live)
        if self.bounded:
            low, high = data.outcomes.low.float(), data.outcomes.high.float()
            self.outcome_low.copy_(low - MARGIN * (high - low))
            self.outcome_high.copy_(high + MARGIN * (high - low))

    @property
    def constant_reward(self) -> float | None:
        """The reward of every training row, where the scale is that of rewards which are all alike; else None.

        Rewards of which one half is 0 and the other 1 have the scale of ones that are all a half: predictions tell.
        """
        mean, std = float(self.target_mean[-1]), float(self.target_std[-1])
        return mean if math.isclose(std, abs(mean) or 1.0, rel_tol=1e-6) else None

    def input_scale(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of what `token` z-scores, each (S + A,)."""
        mean = torch.cat([self.observation_mean, self.action_mean])
        return mean, torch.cat([self.observation_std, self.action_std])

    def token(self, observation: Tensor, action: Tensor) -> Tensor:
        """(..., S) and (..., A) to the network's input (..., S + A)."""
        return torch.cat(
            [
                (observation - self.observation_mean) / self.observation_std,
                (action - self.action_mean) / self.action_std,
            ],
            dim=-1,
        )

    def target(self, observation: Tensor, next_observation: Tensor, reward: Tensor) -> Tensor:
        """What the network should predict: (..., S), (..., S), (...) to (..., S + 1)."""
        change = next_observation - observation if self.delta else next_observation
        return (torch.cat([change, reward.unsqueeze(-1)], dim=-1) - self.target_mean) / self.target_std

    def outcome(self, observation: Tensor, target: Tensor) -> Tensor:
        """The inverse of `target`: (..., S) and (..., S + 1) to next observation and reward (..., S + 1)."""
        outcome = target * self.target_std + self.target_mean
        if self.delta:
            outcome = outcome + nn.functional.pad(observation, (0, 1))
        return outcome.clamp(self.outcome_low, self.outcome_high) if self.bounded else outcome

    def uncertainty(self, variance: Tensor) -> Tensor:
        """Variances (..., S + 1) of unit-scale targets to `||sqrt(variance)||_2 / sqrt(S)`, (...).

        Over live observation dimensions, z-scored by the data's own spread: `Prediction.uncertainty`.
        """
        ratio = self.target_std[:-1] / self.observation_std
        live = self.live.float()
        scaled = variance[..., :-1] * ratio.square() * live
        return (scaled.sum(-1) / live.sum().clamp(min=1)).sqrt()
