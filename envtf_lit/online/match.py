"""Whether an environment is the one that a log was recorded in."""

import numpy as np

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.errors import UserError
from envtf_lit.progress import note
from envtf_lit.robots.tasks import Robot, find_task

Limits = tuple[np.ndarray, np.ndarray]  # least and largest actions, (A,) each


def environment_of(log: OfflineDataset | None) -> str:
    """The task that a log names.

    Raises:
        UserError: it names none, or there is no log.
    """
    if log is not None and log.task is not None:
        return log.task
    missing = "There is no log" if log is None else "The log names no task"
    raise UserError(
        f"{missing} to tell the environment by: give --data.environment a robot such as hopper, or the id of a "
        "Gymnasium environment such as Pendulum-v1."
    )


def check_match(log: OfflineDataset, robot: Robot, limits: Limits) -> None:
    """Says on stderr, in a sentence, what tells the environment from the log's.

    Args:
        log: whose rows stay among those that are learned from.
        robot: of the environment.
        limits: of its actions.

    Raises:
        UserError: observations or actions are of other dimensions.
    """
    theirs, ours = (log.observation_dim, log.action_dim), (robot.observation_dim, robot.action_dim)
    if theirs != ours:
        raise UserError(
            f"The log has {theirs[0]} observations and {theirs[1]} actions, and {robot.env_id} has {ours[0]} and "
            f"{ours[1]}: give --data.environment the one that the log was recorded in, or leave out --data.path."
        )
    found = differences(log, robot, limits)
    if found:
        note(f"The environment is not the log's: {'; '.join(found)}. Rows of the log teach what holds there.")


def differences(log: OfflineDataset, robot: Robot, limits: Limits) -> list[str]:
    """What tells an environment from the log's, a clause each, as far as the log says."""
    found, task = list[str](), None if log.task is None else find_task(log.task)
    if task is not None and task.robot.env_id != robot.env_id:
        found.append(f"the log is of {task.robot.env_id}, this is {robot.env_id}")
    elif task is not None and task.robot.variant != robot.variant:
        variants = [variant.removeprefix("-") or "plain" for variant in (task.robot.variant, robot.variant)]
        found.append(f"the log's {robot.env_id} is the {variants[0]} one, this is the {variants[1]} one")
    logged = (log.action_low, log.action_high)
    if not all(np.allclose(a, b) for a, b in zip(logged, limits, strict=True)):
        spans = [f"{low.tolist()} to {high.tolist()}" for low, high in (logged, limits)]
        found.append(f"the log's actions go from {spans[0]}, this one's from {spans[1]}")
    longest = int(log.episode_lengths.max())
    if longest > robot.max_episode_steps:
        found.append(f"the log's episodes have up to {longest} steps, this one's at most {robot.max_episode_steps}")
    return found
