"""A picture of a robot in the pose that an observation tells of, without any GL."""

import numpy as np

from envtf_lit.errors import UserError
from envtf_lit.robots.tasks import ROBOTS, Robot


class Silhouette:
    """A robot seen from the side, its limbs drawn where observations put them.

    Observations leave out where on the plane the robot is; that is integrated from the velocities.

    Args:
        robot: one of ours.
    """

    def __init__(self, robot: Robot) -> None:
        from envtf_lit.robots.render import draw  # MuJoCo, late: see `Robot.make`

        env = robot.make()
        simulator = env.unwrapped
        self.model, self.time = simulator.model, simulator.dt  # pyright: ignore[reportAttributeAccessIssue]
        env.close()
        self._draw = draw
        self.hidden = self.model.nq + self.model.nv - ROBOTS[robot.name].observation_dim
        self.seen = self.model.nq - self.hidden

    def start(self, observation: np.ndarray) -> np.ndarray:
        """`qpos` (Q,) of an observation (S,) at the origin of the plane."""
        return np.concatenate([np.zeros(self.hidden), observation[: self.seen]])

    def follow(self, position: np.ndarray, observation: np.ndarray) -> np.ndarray:
        """`qpos` (Q,) one step after another, at the next observation (S,)."""
        plane = position[: self.hidden] + self.time * observation[self.seen : self.seen + self.hidden]
        return np.concatenate([plane, observation[: self.seen]])

    def picture(self, position: np.ndarray, size: int = 240) -> np.ndarray:
        """(size, size, 3) uint8 of a pose `qpos` (Q,)."""
        return self._draw(self.model, position[None], size)[0]


def silhouette_of(robot: Robot | None) -> Silhouette:
    """The silhouette of a robot.

    Raises:
        UserError: no robot is known.
    """
    if robot is None:
        raise UserError("There is no robot to draw: name its task, such as 'hopper-medium', or give no render_mode.")
    return Silhouette(robot)
