"""Environments by name, ours or any of Gymnasium's whose observations and actions are vectors."""

import gymnasium
import numpy as np
from gymnasium.error import DependencyNotInstalled, Error
from gymnasium.spaces import Box

from envtf_lit.errors import UserError, did_you_mean
from envtf_lit.robots.tasks import ROBOTS, Robot, find_task
from envtf_lit.robots.termination import never_terminated

NO_LIMIT = 1_000  # steps of an episode where an environment knows no limit


def robot_in(environment: str) -> Robot:
    """The robot that acts in an environment.

    Of one that is none of ours no reference returns are known, so that its scores are NaN, and no rule of termination.

    Args:
        environment: a robot (`hopper`), a task (`hopper-medium-v4`), or a Gymnasium id (`Hopper-v5`, `Pendulum-v1`).

    Raises:
        UserError: there is no such environment, a package of its own is missing, or its observations or actions are no
            vectors, or its actions unbounded.
    """
    known = dict(ROBOTS) | {robot.env_id: robot for robot in _as_registered()}
    if environment in known:
        return known[environment]
    task = find_task(environment)
    return _of_gymnasium(environment, list(known)) if task is None else task.robot


def _as_registered() -> list[Robot]:
    """Ours that are what `gymnasium.make` makes of their ids without arguments."""
    tasks = [find_task(f"{name}-medium{variant}") for name in ROBOTS for variant in ("", "-v4", "-105d")]
    return [task.robot for task in tasks if task is not None and not task.robot.env_kwargs]


def action_limits(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest actions, (A,) float32 each, as the environment has them."""
    env = robot.make()
    space = env.action_space
    env.close()
    assert isinstance(space, Box)
    return space.low.astype(np.float32), space.high.astype(np.float32)


def _of_gymnasium(environment: str, known: list[str]) -> Robot:
    try:
        env = gymnasium.make(environment, disable_env_checker=True)
    except DependencyNotInstalled as error:
        raise UserError(f"{environment} needs a package that is missing: {' '.join(str(error).split())}") from None
    except (Error, ModuleNotFoundError):
        near = did_you_mean(environment, {*known, *gymnasium.registry})
        near = near if near.startswith("did") else "give a robot such as hopper, or the id of a Gymnasium environment."
        raise UserError(f"There is no environment {environment!r}: {near}") from None
    _check_vector(environment, "observations", env.observation_space)
    _check_vector(environment, "actions", env.action_space)
    actions = env.action_space
    assert isinstance(actions, Box) and env.observation_space.shape is not None and env.spec is not None
    if not (np.isfinite(actions.low).all() and np.isfinite(actions.high).all()):
        raise UserError(
            f"{environment} takes actions from {actions.low.min():g} to {actions.high.max():g}, without a bound: wrap "
            "it in gymnasium.wrappers.RescaleAction, and register that."
        )
    env.close()
    (observation_dim,), (action_dim,) = env.observation_space.shape, actions.shape
    limit = float(np.abs([actions.low, actions.high]).max())
    return Robot(
        environment,
        env.spec.id,
        observation_dim,
        action_dim,
        return_random=float("nan"),
        return_expert=float("nan"),
        terminated=never_terminated,
        action_limit=limit,
        max_episode_steps=env.spec.max_episode_steps or NO_LIMIT,
    )


def _check_vector(environment: str, what: str, space: gymnasium.Space) -> None:
    if not isinstance(space, Box) or len(space.shape) != 1:
        kind = f"a {type(space).__name__}" + (f" of shape {space.shape}" if isinstance(space, Box) else "")
        raise UserError(
            f"The {what} of {environment} are {kind}, and policies here take and give vectors of numbers (a Box of one "
            "axis): choose another environment, or a wrapper that makes vectors of them."
        )
