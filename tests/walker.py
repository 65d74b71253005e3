"""A small dataset with Hopper's dimensions: noisy linear motion, a few episodes that fall."""

import numpy as np

from envtf_lit.data.dataset import OfflineDataset


def walker_dataset(episodes: int = 12, length: int = 20, seed: int = 0) -> OfflineDataset:
    """`s' = 0.9 s + 0.1 B a`, height kept near 1.2 so that Hopper's rule does not end imagined episodes at once."""
    random = np.random.default_rng(seed)
    N, S, A = episodes * length, 11, 3
    mixing = random.normal(size=(A, S)) * 0.1
    observations, following = np.zeros((2, N, S), np.float32)
    actions = random.uniform(-1, 1, (N, A)).astype(np.float32)
    for row in range(N):
        if row % length == 0:
            observations[row] = 0.05 * random.normal(size=S)
            observations[row, 0] = 1.2
        else:
            observations[row] = following[row - 1]
        following[row] = 0.9 * observations[row] + 0.1 * actions[row] @ mixing
        following[row, 0] = observations[row, 0] + 0.001 * actions[row, 0]
    ends = np.arange(length - 1, N, length)
    terminated, truncated = np.zeros((2, N), bool)
    terminated[ends[::2]], truncated[ends[1::2]] = True, True
    return OfflineDataset(
        observations=observations,
        actions=actions,
        rewards=(1.0 + following[:, 1]).astype(np.float32),
        next_observations=following,
        terminated=terminated,
        truncated=truncated,
        episode_starts=np.arange(0, N, length),
        action_low=-np.ones(A, np.float32),
        action_high=np.ones(A, np.float32),
        task="hopper-medium-replay",
    )
