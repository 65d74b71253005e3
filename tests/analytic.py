"""A linear world whose every forecast error can be worked out by hand, and data from it."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.world_models.interface import Mode, Prediction


@dataclass
class LinearWorld:
    """s' = matrix s + gain a, r = sum(s); predictive standard deviations are constant."""

    matrix: Tensor
    gain: Tensor
    std: float = 0.1
    epistemic: float | None = None
    novelty: Tensor | None = None
    observation_dim: int = 3
    action_dim: int = 1

    def init(
        self, observations: Tensor, actions: Tensor, lengths: Tensor, window: Tensor | None = None, **posterior
    ) -> Tensor:
        return observations[torch.arange(len(lengths)), lengths - 1]

    def step(self, state: Tensor, action: Tensor, *, mode: Mode = "mean", generator: torch.Generator | None = None):
        mean = torch.cat([state @ self.matrix.T + action @ self.gain.T, state.sum(-1, keepdim=True)], dim=-1)
        aleatoric = torch.full_like(mean, self.std)
        epistemic = None if self.epistemic is None else torch.full_like(mean, self.epistemic)
        value = mean if mode == "mean" else mean + aleatoric * torch.randn(mean.shape, generator=generator)
        uncertainty, log_prob = aleatoric[:, 0], torch.zeros(len(mean))
        prediction = Prediction(
            value[:, :-1], value[:, -1], mean, aleatoric, epistemic, uncertainty, self.novelty, log_prob
        )
        return value[:, :-1], prediction

    def observe(self, state: Tensor, observation: Tensor) -> Tensor:
        return observation

    def current(self, state: Tensor) -> Tensor:
        return state

    def fork(self, state: Tensor, n: int) -> Tensor:
        return state.repeat_interleave(n, 0)

    def gather(self, state: Tensor, index: Tensor) -> Tensor:
        return state[index]

    def same_worlds(self, state: Tensor, former: Tensor, rows: Tensor) -> Tensor:
        return state


def linear_world(error: float = 0.0, **options) -> LinearWorld:
    """A slow rotation in the first two dimensions and a third, constant one; `error` mistakes the rotation's rate."""
    angle = 0.1 + error
    matrix = torch.eye(3)
    matrix[0, 0] = matrix[1, 1] = np.cos(angle)
    matrix[0, 1], matrix[1, 0] = -np.sin(angle), np.sin(angle)
    return LinearWorld(matrix, torch.tensor([[0.1], [0.0], [0.0]]), **options)


def linear_data(lengths: tuple[int, ...], *, noise: float = 0.0, seed: int = 0) -> OfflineDataset:
    """Episodes of the true world under random actions; the third dimension is always zero."""
    rng, world, parts = np.random.default_rng(seed), linear_world(), []
    for length in lengths:
        state = torch.tensor([*rng.normal(size=2), 0.0], dtype=torch.float32)[None]
        for t in range(length):
            action = torch.from_numpy(rng.uniform(-1, 1, (1, 1)).astype(np.float32))
            following, prediction = world.step(state, action)
            following = following + torch.tensor([*rng.normal(size=2, scale=noise), 0.0], dtype=torch.float32)
            reward = prediction.reward + float(rng.normal(scale=noise))
            parts.append((state, action, reward, following, t == length - 1))
            state = following
    observations, actions, rewards, following, ends = zip(*parts, strict=True)
    ends = np.array(ends)
    return OfflineDataset(
        observations=torch.cat(observations).numpy(),
        actions=torch.cat(actions).numpy(),
        rewards=torch.cat(rewards).numpy(),
        next_observations=torch.cat(following).numpy(),
        terminated=np.zeros(len(ends), dtype=bool),
        truncated=ends,
        episode_starts=np.concatenate([[0], np.flatnonzero(ends[:-1]) + 1]),
        action_low=np.array([-1.0], dtype=np.float32),
        action_high=np.array([1.0], dtype=np.float32),
    )
