"""Gymnasium's Pendulum-v1 in closed form, as a world model that is never wrong: what a learned one is held against."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from envtf_lit.errors import UserError
from envtf_lit.planning.value_iteration import Axis, Chart
from envtf_lit.world_models.interface import Mode, Prediction

ENV_ID = "Pendulum-v1"
MAX_SPEED, MAX_TORQUE = 8.0, 2.0  # rad/s, N m
GRAVITY, STEP = 10.0, 0.05  # m/s^2, s; mass and length are 1


@dataclass
class TruePendulum:
    """The simulator itself as a `WorldModel`: states are observations (B, 3), cos and sin of the angle and its rate."""

    observation_dim: int = 3
    action_dim: int = 1

    def init(
        self,
        observations: Tensor,
        actions: Tensor,
        lengths: Tensor,
        window: Tensor | None = None,
        *,
        posterior: float = 0.0,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """See `WorldModel.init`. Of the histories only the current observation counts."""
        if posterior > 0:
            raise UserError("The true pendulum has no posterior to draw from: set posterior to 0.")
        window = torch.arange(len(lengths), device=lengths.device) if window is None else window
        return observations[window, lengths - 1]

    def step(
        self, state: Tensor, action: Tensor, *, mode: Mode = "mean", generator: torch.Generator | None = None
    ) -> tuple[Tensor, Prediction]:
        """See `WorldModel.step`. There is nothing to draw; torques beyond 2 N m are clipped, as the simulator does."""
        angle, rate, torque = (
            torch.atan2(state[:, 1], state[:, 0]),
            state[:, 2],
            action[:, 0].clamp(-MAX_TORQUE, MAX_TORQUE),
        )
        reward = -(angle.square() + 0.1 * rate.square() + 0.001 * torque.square())
        rate = (rate + (1.5 * GRAVITY * angle.sin() + 3.0 * torque) * STEP).clamp(-MAX_SPEED, MAX_SPEED)
        angle = angle + rate * STEP
        following = torch.stack([angle.cos(), angle.sin(), rate], -1)
        mean, none = torch.cat([following, reward[:, None]], -1), torch.zeros_like(reward)
        sure = torch.zeros_like(mean)
        return following, Prediction(following, reward, mean, sure, sure, none, none, none)

    def observe(self, state: Tensor, observation: Tensor) -> Tensor:
        """See `WorldModel.observe`."""
        return observation

    def current(self, state: Tensor) -> Tensor:
        """See `WorldModel.current`."""
        return state

    def fork(self, state: Tensor, n: int) -> Tensor:
        """See `WorldModel.fork`."""
        return state.repeat_interleave(n, 0)

    def gather(self, state: Tensor, index: Tensor) -> Tensor:
        """See `WorldModel.gather`."""
        return state[index]

    def same_worlds(self, state: Tensor, former: Tensor, rows: Tensor) -> Tensor:
        """See `WorldModel.same_worlds`. There is one world."""
        return state


def _observed(point: Tensor) -> Tensor:
    return torch.stack([point[..., 0].cos(), point[..., 0].sin(), point[..., 1]], -1)


def _point(observation: Tensor) -> Tensor:
    return torch.stack([torch.atan2(observation[..., 1], observation[..., 0]), observation[..., 2]], -1)


CHART = Chart((Axis(-math.pi, math.pi, 101, circular=True), Axis(-MAX_SPEED, MAX_SPEED, 101)), _observed, _point)
