"""Logs of machines that were held back, and the true simulators that they came from.

A narrow log has a few, nearly equal episodes, and shows nothing of what lies just beyond them: there, faster than the
fastest recorded step, each step costs 100. An odometer or a clock among its observations lets an actor learn by heart
which action follows which.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import TimeAwareObservation
from torch import Tensor

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.data.dataset import OfflineDataset, starts_from_ends
from envtf_lit.robots.tasks import ROBOTS, Robot
from envtf_lit.zoo.snapshots import load_snapshot, read_series

EPISODES = 18
EAGER, FASTER = 2, 0.3  # the first episodes, and by how many m/s their governor lets them go faster
RUIN = -100.0  # reward of a step beyond the limit
BEYOND = 1.001  # the limit, in multiples of the fastest recorded step
X_VELOCITY = {"halfcheetah": 8, "hopper": 5, "walker2d": 8}  # of the robot's own observation
FIRST_SEED = 100  # of the episodes' starts
ODOMETER = {"exclude_current_positions_from_observation": False}


@dataclass(frozen=True)
class Machine:
    """A robot that was held back, and what its log shows.

    Attributes:
        words: what it is.
        robot: one of `X_VELOCITY`.
        snapshot: of the zoo, whose policy drives it: the medium one, the expert, or after so many steps of training.
        gain: by which the policy's actions are multiplied before they are cut at their limits.
        governor: speed in m/s beyond which actions fade to a fifth; None has none.
        noise: standard deviation of what is added to actions.
        odometer: the distance from the origin comes first in observations.
        clock: the number of steps since the start comes last in observations.
    """

    words: str
    robot: str = "halfcheetah"
    snapshot: Literal["medium", "expert"] | int = "medium"
    gain: float = 2.5
    governor: float | None = 2.5
    noise: float = 0.02
    odometer: bool = True
    clock: bool = False


MACHINES = {
    "governed": Machine("HalfCheetah's medium policy, saturated and governed, with an odometer"),
    "plain": Machine(
        "HalfCheetah's medium policy as it is, noise .1, with an odometer", gain=1.0, governor=None, noise=0.1
    ),
    "clock": Machine(
        "HalfCheetah's medium policy, saturated and governed, with a clock", odometer=False, clock=True
    ),
    "expert": Machine(
        "HalfCheetah's expert, noise .05", snapshot="expert", gain=1.0, governor=None, noise=0.05, odometer=False
    ),
    "walker2d": Machine(
        "Walker2d at a third of its speed, saturated, with an odometer; no episode falls",
        robot="walker2d", snapshot=100_000, gain=1.5, governor=None,
    ),
}  # fmt: skip


class Cliff(gymnasium.Wrapper):
    """A step faster than `limit` m/s is paid with `RUIN`.

    Args:
        env: a robot of Gymnasium's that says its `x_velocity`.
        limit: of the speed.
    """

    def __init__(self, env: gymnasium.Env, limit: float) -> None:
        super().__init__(env)
        self.limit = limit

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, RUIN if info["x_velocity"] > self.limit else reward, terminated, truncated, info


@dataclass(frozen=True)
class HeldBack(Robot):
    """A machine's true simulator, for `evaluate_policy`: the robot with the machine's sensors, and the cliff.

    Attributes:
        limit: m/s beyond which each step costs.
        clock: the number of steps comes last in observations.
    """

    limit: float = np.inf
    clock: bool = False

    def make(self) -> gymnasium.Env:
        env = Cliff(super().make(), self.limit)
        return TimeAwareObservation(env, flatten=True, normalize_time=False) if self.clock else env


def simulator(machine: Machine, limit: float = np.inf) -> HeldBack:
    """The machine's true simulator, with the cliff at `limit` m/s."""
    robot = ROBOTS[machine.robot]
    sensors = {
        "observation_dim": robot.observation_dim + machine.odometer + machine.clock,
        "env_kwargs": robot.env_kwargs | (ODOMETER if machine.odometer else {}),
    }
    return HeldBack(**vars(robot) | sensors, limit=limit, clock=machine.clock)


def make_log(machine: Machine, *, episodes: int = EPISODES, steps: int = 1_000) -> tuple[OfflineDataset, float]:
    """Lets the machine run, held back.

    Args:
        machine: which.
        episodes: how many; two at least.
        steps: of each, at most.

    Returns:
        The log, without a task, and the speed in m/s beyond which ruin begins: a thousandth above the fastest recorded.
    """
    rng, env = np.random.default_rng(0), simulator(machine).make()
    rows: list[tuple[Any, ...]] = []
    for episode in range(episodes):
        rows += _episode(env, driver(machine, eager=episode < EAGER), machine.noise, rng, FIRST_SEED + episode, steps)
    env.close()
    observations, actions, rewards, following, speeds, terminated, ends = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    limits = np.ones(actions.shape[1], np.float32)
    log = OfflineDataset(
        observations=observations.astype(np.float32),
        actions=actions,
        rewards=rewards.astype(np.float32),
        next_observations=following.astype(np.float32),
        terminated=terminated,
        truncated=ends & ~terminated,
        episode_starts=starts_from_ends(ends),
        action_low=-limits,
        action_high=limits,
    )
    return log, float(BEYOND * speeds.max())


def driver(machine: Machine, *, eager: bool = False) -> Callable[[Tensor], Tensor]:
    """What acts on (B, S) observations of the machine, before noise; `eager`: .3 m/s faster."""
    robot = ROBOTS[machine.robot]
    actor, first = _actor(robot, machine.snapshot), int(machine.odometer)

    def act(seen: Tensor) -> Tensor:
        own = seen[:, first : first + robot.observation_dim]
        action = machine.gain * actor.act(own, deterministic=True)
        if machine.governor is not None:
            speed, most = own[:, X_VELOCITY[machine.robot], None], machine.governor + FASTER * eager
            action = action * (0.2 + 0.8 * torch.sigmoid(3.0 * (most - speed)))
        return action.clamp(-1.0, 1.0)

    return act


def _actor(robot: Robot, snapshot: Literal["medium", "expert"] | int) -> TanhGaussianActor:
    series = read_series(robot)
    return load_snapshot(series, snapshot if isinstance(snapshot, int) else getattr(series, snapshot).steps)


def _episode(
    env: gymnasium.Env,
    act: Callable[[Tensor], Tensor],
    noise: float,
    rng: np.random.Generator,
    seed: int,
    steps: int,
) -> list[tuple[Any, ...]]:
    """(observation, action, reward, next observation, m/s, terminated, whether it is the last) of each step."""
    rows: list[tuple[Any, ...]] = []
    observation, _ = env.reset(seed=seed)
    for step in range(steps):
        with torch.no_grad():
            action = act(torch.as_tensor(observation, dtype=torch.float32)[None])[0].numpy()
        action = np.clip(action + noise * rng.normal(size=action.shape), -1.0, 1.0).astype(np.float32)
        following, reward, terminated, _, info = env.step(action)
        last = terminated or step == steps - 1
        rows.append((observation, action, float(reward), following, info["x_velocity"], terminated, last))
        observation = following
        if last:
            break
    return rows
