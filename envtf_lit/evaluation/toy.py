"""A world of one number, small enough to see all that a model believes of it."""

from dataclasses import dataclass

import numpy as np
import torch

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.world_models.interface import WorldModel

SEEN = ((-2.0, -0.5), (0.7, 2.0))  # where the log has been; between and beyond nobody was
QUIET, LOUD = 0.03, 0.25  # standard deviation of the noise left and right
STEPS = 20  # of an episode


def toy_log(rows: int, *, seed: int) -> OfflineDataset:
    """A log of x′ = sin(3x) + noise, the noise small on the left and large on the right, with a gap in the middle.

    States are drawn anew for each row, actions do nothing, and the reward is x.

    Args:
        rows: a multiple of 20, at least 40.
        seed: of states, actions and noise.
    """
    rng = np.random.default_rng(seed)
    low, high = np.array(SEEN).T
    side = rng.integers(2, size=rows)
    x = rng.uniform(low[side], high[side])
    mean, std = toy_truth(x)
    ends = np.arange(1, rows + 1) % STEPS == 0
    return OfflineDataset(
        observations=x[:, None].astype(np.float32),
        actions=rng.uniform(-1.0, 1.0, (rows, 1)).astype(np.float32),
        rewards=x.astype(np.float32),
        next_observations=(mean + std * rng.normal(size=rows))[:, None].astype(np.float32),
        terminated=np.zeros(rows, bool),
        truncated=ends,
        episode_starts=np.arange(0, rows, STEPS, dtype=np.int64),
        action_low=-np.ones(1, np.float32),
        action_high=np.ones(1, np.float32),
    )


def toy_truth(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of x′ at x, of the same shape."""
    return np.sin(3.0 * x), np.where(x < 0.0, QUIET, LOUD)


@dataclass(frozen=True, eq=False)
class Beliefs:
    """What a model predicts at N states.

    Attributes:
        x: (N,) the states.
        mean: (N,) of x′.
        aleatoric: (N,) standard deviation of the noise, as predicted.
        epistemic: (N,) standard deviation of what the model does not know.
    """

    x: np.ndarray
    mean: np.ndarray
    aleatoric: np.ndarray
    epistemic: np.ndarray

    @property
    def std(self) -> np.ndarray:
        """(N,) of both together."""
        return np.hypot(self.aleatoric, self.epistemic)


@torch.no_grad()
def beliefs(model: WorldModel, x: np.ndarray) -> Beliefs:
    """What a model of the toy world predicts at states (N,), without any history and with the action 0."""
    states = torch.from_numpy(x.astype(np.float32))[:, None]
    begun = model.init(states[:, None], torch.zeros(len(x), 0, 1), torch.ones(len(x), dtype=torch.int64))
    _, found = model.step(begun, torch.zeros(len(x), 1))
    nothing = torch.zeros_like(found.aleatoric)
    columns = found.mean, found.aleatoric, nothing if found.epistemic is None else found.epistemic
    return Beliefs(x, *(column[:, 0].numpy() for column in columns))
