"""World models of robots whose velocities are observed clipped: imagined ones stay where data hold them, too."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from envtf_lit.robots.tasks import VELOCITY_LIMIT, Robot
from envtf_lit.world_models.interface import Mode, Prediction, WorldModel


def as_observed(model: WorldModel, robot: Robot | None) -> WorldModel:
    """The model, its imagined states clipped where the robot's observations are; None is a robot of one's own."""
    first = None if robot is None else robot.clipped_from
    return model if first is None else ClippedWorld(model, first)


def bare(model: WorldModel) -> WorldModel:
    """The model that predicts, without the clipping of `as_observed`."""
    return model.model if isinstance(model, ClippedWorld) else model


class ClippedWorld:
    """A world model whose next observations are clipped to [-10, 10] from a dimension on (Hopper, Walker2d).

    The simulator shows no others, so no state beyond is like any that the model has seen. `Prediction.mean` and
    `log_prob` are of what the model said. A gradient ends where a velocity is clipped, as the observation's does.

    Args:
        model: that predicts.
        first: dimension of the first velocity; the rest are velocities, too.
    """

    def __init__(self, model: WorldModel, first: int) -> None:
        self.model, self.first = model, first
        self.observation_dim, self.action_dim = model.observation_dim, model.action_dim

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
        """See `WorldModel.init`."""
        return self.model.init(observations, actions, lengths, window, posterior=posterior, generator=generator)

    def step(
        self, state: Any, action: Tensor, *, mode: Mode = "mean", generator: torch.Generator | None = None
    ) -> tuple[Any, Prediction]:
        """See `WorldModel.step`."""
        state, prediction = self.model.step(state, action, mode=mode, generator=generator)
        pose, velocity = prediction.observation[:, : self.first], prediction.observation[:, self.first :]
        observation = torch.cat([pose, velocity.clamp(-VELOCITY_LIMIT, VELOCITY_LIMIT)], -1)
        return self.model.observe(state, observation), replace(prediction, observation=observation)

    def observe(self, state: Any, observation: Tensor) -> Any:
        """See `WorldModel.observe`."""
        return self.model.observe(state, observation)

    def current(self, state: Any) -> Tensor:
        """See `WorldModel.current`."""
        return self.model.current(state)

    def fork(self, state: Any, n: int) -> Any:
        """See `WorldModel.fork`."""
        return self.model.fork(state, n)

    def gather(self, state: Any, index: Tensor) -> Any:
        """See `WorldModel.gather`."""
        return self.model.gather(state, index)

    def same_worlds(self, state: Any, former: Any, rows: Tensor) -> Any:
        """See `WorldModel.same_worlds`."""
        return self.model.same_worlds(state, former, rows)
