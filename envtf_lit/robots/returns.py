"""A policy's returns in MuJoCo: one episode per seed, all episodes advancing together."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from envtf_lit.errors import UserError
from envtf_lit.policy import Policy, StatefulPolicy, begin_episodes
from envtf_lit.progress import progress_bar
from envtf_lit.robots.tasks import Robot

SEED_OFFSET = 1000  # keeps evaluation seeds apart from those that data was collected with
# A matrix product may round a row differently in a batch of another size, and contacts amplify the last bit. The policy
# is therefore always asked for this many rows, and episode i always sits in row i % ROWS. Not so planners, to whom each
# row is much work: their episodes may come out otherwise, by rounding, beside another number of others.
ROWS = 32


@dataclass(frozen=True, eq=False)
class Episode:
    """What happened in one episode of T steps.

    Attributes:
        seed: given to the environment's reset.
        observations: (T + 1, S) float32, from the reset to the last state.
        actions: (T, A) float32.
        rewards: (T,) float64.
        positions: (T + 1, Q) float64, MuJoCo's generalised coordinates `qpos`; Q is 0 in another simulator.
    """

    seed: int
    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    positions: np.ndarray


@dataclass(frozen=True, eq=False)
class Returns:
    """E episodes of one policy.

    Attributes:
        returns: (E,) float64, undiscounted sums of rewards.
        lengths: (E,) int64, steps.
        scores: (E,) float64, D4RL-normalised: 0 is a random policy, 100 D4RL's expert; NaN of a robot without these.
        median: the episode of median return (the lower of the two middle ones where E is even).
    """

    returns: np.ndarray
    lengths: np.ndarray
    scores: np.ndarray
    median: Episode


def evaluate_policy(policy: Policy, robot: Robot, *, episodes: int, seed: int, progress: bool = True) -> Returns:
    """Runs exactly one episode per seed `seed + 1000 + i`, with deterministic actions.

    Episode i comes out the same whatever number of episodes runs beside it, but for the rounding of stateful policies.

    Args:
        policy: acts on float32 observations (B, S); a stateful one is reset before each group of at most 32 episodes.
        robot: whose environment is made.
        episodes: number of episodes, at least 1.
        seed: base of the episodes' seeds.
        progress: whether to show a bar with the time left.

    Raises:
        UserError: no episodes are asked for, or the policy returns actions that are not finite.
    """
    if episodes < 1:
        raise UserError(f"A policy is scored on at least one episode: {episodes} were asked for; raise the number.")
    seeds = [seed + SEED_OFFSET + i for i in range(episodes)]
    groups = [seeds[start : start + ROWS] for start in range(0, episodes, ROWS)]
    with progress_bar("Scoring", len(groups) * robot.max_episode_steps, visible=progress) as update:
        played = [episode for group in groups for episode in _play(policy, robot, group, lambda: update(advance=1))]
    returns = np.array([episode.rewards.sum() for episode in played])
    return Returns(
        returns=returns,
        lengths=np.array([len(episode.rewards) for episode in played]),
        scores=np.array([robot.normalised_score(value) for value in returns]),
        median=played[int(np.argsort(returns, kind="stable")[(episodes - 1) // 2])],
    )


class _Lane:
    """One environment playing one episode, and the record of it."""

    def __init__(self, robot: Robot, seed: int) -> None:
        # The plain environment, not gymnasium's vector of them: that one restarts (or refuses to step on) copies whose
        # episode is over, and steps all until the longest is done. Here a finished copy costs nothing more.
        self.env = robot.make()
        self.seed, self.running = seed, True
        observation, _ = self.env.reset(seed=seed)
        self.observations, self.positions = [observation.astype(np.float32)], [self._qpos()]
        self.actions: list[np.ndarray] = []
        self.rewards: list[float] = []

    def _qpos(self) -> np.ndarray:
        data = getattr(self.env.unwrapped, "data", None)
        return getattr(data, "qpos", np.empty(0)).copy()

    def step(self, action: np.ndarray) -> None:
        observation, reward, terminated, truncated, _ = self.env.step(action)
        self.observations.append(observation.astype(np.float32))
        self.positions.append(self._qpos())
        self.actions.append(action)
        self.rewards.append(float(reward))
        self.running = not (terminated or truncated)

    def finish(self) -> Episode:
        self.env.close()
        columns = (np.stack(self.observations), np.stack(self.actions), np.array(self.rewards))
        return Episode(self.seed, *columns, positions=np.stack(self.positions))


def _play(policy: Policy, robot: Robot, seeds: list[int], advance: Callable[[], None]) -> list[Episode]:
    lanes = [_Lane(robot, seed) for seed in seeds]
    batch = torch.zeros(len(seeds) if isinstance(policy, StatefulPolicy) else ROWS, robot.observation_dim)
    begin_episodes(policy)
    while any(lane.running for lane in lanes):
        for row, lane in enumerate(lanes):
            batch[row] = torch.from_numpy(lane.observations[-1])
        actions = policy.act(batch, deterministic=True).cpu().numpy()
        if not np.isfinite(actions[: len(lanes)]).all():
            raise UserError("The policy returned an action that is not finite: its weights are damaged; train it anew.")
        for lane, action in zip(lanes, actions, strict=False):
            if lane.running:
                lane.step(action)
        advance()
    return [lane.finish() for lane in lanes]
