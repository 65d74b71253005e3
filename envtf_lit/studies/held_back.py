"""A machine that was held back: a log that a speed governor kept slow, and what awaits whoever goes faster."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset, starts_from_ends
from envtf_lit.imagination.histories import BranchPoints
from envtf_lit.imagination.rollouts import imagine
from envtf_lit.policy import Policy
from envtf_lit.robots.tasks import ROBOTS
from envtf_lit.robots.termination import never_terminated
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.zoo.record import record
from envtf_lit.zoo.snapshots import load_snapshot, read_series

ROBOT = ROBOTS["halfcheetah"]
SPEED = 8  # the dimension of the observation that is the speed, in m/s
RECORDED_SPEED = 2.5  # m/s around which the log's governor fades the actions out
GAIN, IDLE, SHARPNESS = 2.5, 0.2, 3.0  # of the governed actions: they saturate, and fade around the speed
PUNISHMENT = -100.0  # reward of a step faster than any that was recorded
NOISE = 0.02  # of the recorded actions


class Governed:
    """The zoo's medium HalfCheetah with its actions turned up, and faded out where it is faster than allowed.

    Args:
        speed: in m/s.
        noise: standard deviation of Gaussian noise on its actions.
    """

    def __init__(self, speed: float, noise: float = 0.0) -> None:
        series = read_series(ROBOT)
        self.policy: Policy = load_snapshot(series, series.medium.steps)
        self.speed, self.noise = speed, noise

    def act(self, observation: Tensor, deterministic: bool = True, generator: torch.Generator | None = None) -> Tensor:
        """Observations (B, 17) to actions (B, 6)."""
        throttle = torch.sigmoid((self.speed - observation[:, SPEED : SPEED + 1]) * SHARPNESS)
        action = GAIN * self.policy.act(observation, deterministic=True) * (IDLE + (1.0 - IDLE) * throttle)
        noise = self.noise * torch.randn(action.shape, generator=generator)
        return (action + noise).clamp(-1.0, 1.0)


def held_back_log(episodes: int, *, seed: int) -> OfflineDataset:
    """A log of nearly equal episodes of 1,000 steps, at about 3 m/s, for a governor of 2.5 m/s never brakes. It never shows what a higher speed costs.

    Args:
        episodes: at least 2.
        seed: of the robot's starts and of the noise.
    """
    columns = _play(RECORDED_SPEED, episodes, seed=seed, noise=NOISE)
    limit = np.ones(ROBOT.action_dim, np.float32)
    starts = starts_from_ends(columns["terminated"] | columns["truncated"])
    return OfflineDataset(**columns, episode_starts=starts, action_low=-limit, action_high=limit)


def promises(
    model: WorldModel, log: OfflineDataset, speeds: Sequence[float], *, starts: int, steps: int, seed: int
) -> pd.DataFrame:
    """What a model of the log promises of faster governors, and what they get in truth.

    Args:
        model: trained on the log, on the CPU.
        log: of `held_back_log`.
        speeds: of the governors, in m/s.
        starts: rollouts, from rows of the log.
        steps: of each rollout.
        seed: of these rows, and of the true episode's start.

    Returns:
        A row for each speed: `promised` and `true` mean reward of a step, and `halted`, the share of rollouts that a
        novelty limit of 1 ends.
    """
    fastest = float(np.asarray(log.next_observations)[:, SPEED].max())
    begin = BranchPoints(log).draw(starts, 16, torch.Generator().manual_seed(seed))
    rows = []
    for speed in speeds:
        how = dict(horizon=0, expansion=steps, terminated=never_terminated)
        run = imagine(model, Governed(speed), begin, **how)
        halted = imagine(model, Governed(speed), begin, novelty_limit=1.0, **how).halted.any(0)
        played = _play(speed, 1, seed=seed + 1)
        true = np.where(played["next_observations"][:, SPEED] > fastest, PUNISHMENT, played["rewards"])
        rows.append((speed, float(run.rewards[run.valid].mean()), float(true.mean()), float(halted.double().mean())))
    return pd.DataFrame(rows, columns=["speed", "promised", "true", "halted"])


def _play(speed: float, episodes: int, *, seed: int, noise: float = 0.0) -> dict[str, np.ndarray]:
    seeds = [seed * 1_000 + episode for episode in range(min(episodes, 9))]
    generator = torch.Generator().manual_seed(seed)
    rows = episodes * ROBOT.max_episode_steps
    return record(ROBOT, Governed(speed, noise), rows, seeds=seeds, generator=generator)
