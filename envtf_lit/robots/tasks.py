"""Robots and the twenty tasks: environment ids, dimensions, reference scores."""

import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from envtf_lit.errors import UserError, did_you_mean
from envtf_lit.robots.termination import (
    ant_terminated,
    hopper_terminated,
    never_terminated,
    walker2d_terminated,
)

if TYPE_CHECKING:  # torch takes seconds to import, and names and options are read without it
    import gymnasium
    from torch import Tensor

VELOCITY_LIMIT = 10.0  # beyond which some robots' velocities are observed as that
TIERS = ("random", "medium", "medium-replay", "medium-expert", "full-replay")


@contextmanager
def quiet_mujoco() -> Iterator[None]:
    """Keeps MuJoCo's warnings off the screen and out of MUJOCO_LOG.TXT.

    HalfCheetah's own model file makes MuJoCo 4 complain at each start, and every state that an imagination makes
    impossible would be worth a line.
    """
    import mujoco

    mujoco.set_mju_user_warning(lambda message: None)  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)  # pyright: ignore[reportAttributeAccessIssue]


@dataclass(frozen=True)
class Robot:
    """A simulated robot and what is known of it without data.

    `return_random` and `return_expert` are D4RL's reference returns, measured on the older -v2 environments; scores on
    -v5 are therefore comparable among themselves, not with D4RL's tables. Two things set -v5 apart. The step in which
    Hopper, Walker2d or Ant falls lacks the reward of one for being healthy that it has in -v4. Ant pays for contact
    forces, up to 0.039 a step, whether it observes them or not; in D4RL's Ant they are zero, and -v4's pays nothing.

    `variant` is empty for the robot as the twenty tasks have it, else the suffix of its tasks' names: `-v4` for
    Gymnasium's older simulation, `-105d` for Ant with the contact forces among its observations, `-hidden` for a body
    that is another one in each episode (see `hidden_dynamics.HiddenDynamics`).
    """

    name: str
    env_id: str
    observation_dim: int
    action_dim: int
    return_random: float
    return_expert: float
    terminated: "Callable[[Tensor], Tensor]"  # next observation (..., S) -> bool (...)
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    action_limit: float = 1.0  # actions lie in [-limit, limit]
    max_episode_steps: int = 1000
    variant: str = ""
    clipped_from: int | None = None  # first dimension (of the velocities) that is observed clipped; None: none is

    def make(self) -> "gymnasium.Env":
        """The simulator, without Gymnasium's checks of our use of it and its advice to leave -v4."""
        import gymnasium

        with quiet_mujoco(), warnings.catch_warnings():
            warnings.filterwarnings("ignore", r".*is out of date", DeprecationWarning)
            env = gymnasium.make(
                self.env_id, max_episode_steps=self.max_episode_steps, disable_env_checker=True, **self.env_kwargs
            )
        if not self.hidden_dynamics:
            return env
        from envtf_lit.robots.hidden_dynamics import HiddenDynamics

        return HiddenDynamics(env)

    @property
    def hidden_dynamics(self) -> bool:
        """Whether friction, mass and actuator strength are drawn anew in each episode, unobserved."""
        return self.variant == "-hidden"

    def clipped(self, observations: "Tensor") -> "Tensor":
        """(...) bool, whether observations (..., S) may hide larger velocities than they show."""
        first = self.observation_dim if self.clipped_from is None else self.clipped_from
        return (observations[..., first:].abs() >= VELOCITY_LIMIT).any(-1)

    def normalised_score(self, episode_return: float) -> float:
        """D4RL's score: 0 is a random policy, 100 its expert. `100 (G - G_random) / (G_expert - G_random)`."""
        return 100.0 * (episode_return - self.return_random) / (self.return_expert - self.return_random)


ROBOTS = {
    robot.name: robot
    for robot in (
        Robot("hopper", "Hopper-v5", 11, 3, -20.272305, 3234.3, hopper_terminated, clipped_from=5),
        Robot("halfcheetah", "HalfCheetah-v5", 17, 6, -280.178953, 12135.0, never_terminated),
        Robot("walker2d", "Walker2d-v5", 17, 6, 1.629008, 4592.3, walker2d_terminated, clipped_from=8),
        # without the contact forces: the dimensions that are not constant zero in D4RL's Ant
        Robot("ant", "Ant-v5", 27, 8, -325.6, 3879.7, ant_terminated, {"include_cfrc_ext_in_observation": False}),
    )
}


@dataclass(frozen=True)
class Task:
    """A robot and a tier of data, such as `hopper-medium-replay`."""

    robot: Robot
    tier: str

    @property
    def name(self) -> str:
        return f"{self.robot.name}-{self.tier}{self.robot.variant}"


TASKS = {task.name: task for task in (Task(robot, tier) for robot in ROBOTS.values() for tier in TIERS)}


VARIANTS = re.compile(r"(?P<task>.+?)(?P<variant>-v4|-105d|-hidden)")


def get_task(name: str) -> Task:
    """The task of that name; `-v4`, `-105d` and `-hidden` after one of the twenty names ask for its robot's variants.

    Raises:
        UserError: there is no such task; the message holds the nearest one.
    """
    task = find_task(name)
    if task is None:
        raise UserError(f"Unknown task {name!r}: {did_you_mean(name, TASKS)}")
    return task


def find_task(name: str) -> Task | None:
    """The task of that name or None."""
    match = VARIANTS.fullmatch(name)
    if match is None or match["task"] not in TASKS:
        return TASKS.get(name)
    task = TASKS[match["task"]]
    if match["variant"] == "-v4":
        return replace(task, robot=_gymnasium_v4(task.robot))
    if match["variant"] == "-hidden":
        return replace(task, robot=replace(task.robot, variant="-hidden"))
    return replace(task, robot=_with_contact_forces(task.robot)) if task.robot.name == "ant" else None


def _gymnasium_v4(robot: Robot) -> Robot:
    """The simulation that is nearest to the one D4RL's v2 files were made in; -v4's Ant has the 27 dimensions alone."""
    return replace(robot, env_id=robot.env_id.replace("-v5", "-v4"), env_kwargs={}, variant="-v4")


def _with_contact_forces(robot: Robot) -> Robot:
    """Ant as -v5 makes it by default: 78 contact forces and torques follow the 27 dimensions."""
    return replace(robot, observation_dim=105, env_kwargs={}, variant="-105d")
