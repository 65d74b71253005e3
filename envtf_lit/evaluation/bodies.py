"""Episodes of a robot whose body is chosen, not drawn: the same actions in several, and one that changes on the way."""

from collections.abc import Mapping

import numpy as np
import torch

from envtf_lit.errors import UserError
from envtf_lit.policy import Policy
from envtf_lit.robots.hidden_dynamics import Factors, HiddenDynamics
from envtf_lit.robots.silhouette import Silhouette
from envtf_lit.robots.tasks import ROBOTS, Robot
from envtf_lit.world_models.forecast import Trajectories


def same_actions(
    robot: Robot, bodies: Mapping[str, Factors], actions: np.ndarray, *, seed: int
) -> dict[str, np.ndarray]:
    """What the same actions do from the same start in each of some bodies.

    Args:
        robot: a variant with hidden dynamics.
        bodies: by name.
        actions: (T, A).
        seed: of the start.

    Returns:
        By name, observations (T + 1, S) float32; fewer where the robot falls.

    Raises:
        UserError: the robot has no hidden dynamics.
    """
    found, env = {}, _chosen(robot)
    for name, body in bodies.items():
        seen = [env.reset(seed=seed)[0]]
        env.apply(body)
        for action in actions:
            observation, _, terminated, _, _ = env.step(action)
            seen.append(observation)
            if terminated:
                break
        found[name] = np.array(seen, np.float32)
    env.close()
    return found


def travelled(robot: Robot, observations: np.ndarray) -> np.ndarray:
    """(T + 1,) metres along the ground since the first of observations (T + 1, S), by the speed that they tell."""
    silhouette = Silhouette(robot)
    along = silhouette.time * observations[:, silhouette.seen].astype(np.float64)
    return np.cumsum(along) - along[0]


def changed_bodies(
    robot: Robot, policy: Policy, before: Factors, after: Factors, *, at: int, steps: int, episodes: int, seed: int
) -> Trajectories:
    """Episodes in which the body becomes another one, while the policy that acts knows of neither.

    Args:
        robot: a variant with hidden dynamics.
        policy: acts with sampled actions; it knows the robot without what a variant adds.
        before, after: the bodies.
        at: steps in the first one.
        steps: in all; an episode ends earlier where the robot falls.
        episodes: number of episodes, side by side.
        seed: of starts (`seed + i` of episode i) and actions.

    Raises:
        UserError: the robot has no hidden dynamics.
    """
    envs, generator = [_chosen(robot) for _ in range(episodes)], torch.Generator().manual_seed(seed)
    observations = torch.zeros(episodes, steps, robot.observation_dim)
    actions = torch.zeros(episodes, steps, robot.action_dim)
    targets = torch.zeros(episodes, steps, robot.observation_dim + 1)
    lengths, running = torch.zeros(episodes, dtype=torch.long), [True] * episodes
    seen = np.array([env.reset(seed=seed + i)[0] for i, env in enumerate(envs)], np.float32)
    known = ROBOTS[robot.name].observation_dim
    for t in range(steps):
        observations[:, t] = torch.from_numpy(seen)
        actions[:, t] = policy.act(observations[:, t, :known], False, generator)
        for i, env in enumerate(envs):
            if not running[i]:
                continue
            if t in (0, at):
                env.apply(before if t < at else after)
            seen[i], reward, terminated, _, _ = env.step(actions[i, t].numpy())
            targets[i, t] = torch.from_numpy(np.append(seen[i], np.float32(reward)))
            lengths[i], running[i] = t + 1, not terminated
    for env in envs:
        env.close()
    padding = torch.arange(steps) >= lengths[:, None]
    for column in (observations, actions, targets):
        column[padding] = 0.0
    return Trajectories(observations, actions, targets, lengths)


def _chosen(robot: Robot) -> HiddenDynamics:
    env = robot.make()
    if not isinstance(env, HiddenDynamics):
        env.close()
        raise UserError(
            f"{robot.name}{robot.variant} has one body, the same in all episodes: take its variant with hidden "
            f"dynamics, such as {robot.name}-medium-hidden."
        )
    return env
