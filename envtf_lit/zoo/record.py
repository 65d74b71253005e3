"""Whole episodes of a policy in several simulators at once, as columns of transitions."""

from dataclasses import dataclass, field

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from envtf_lit.data.dataset import COLUMNS
from envtf_lit.policy import Policy
from envtf_lit.robots.tasks import ROBOTS, Robot

Columns = dict[str, np.ndarray]  # rows under the names in `COLUMNS`, float32 and bool


def record(robot: Robot, policy: Policy, rows: int, *, seeds: list[int], generator: torch.Generator) -> Columns:
    """Steps all environments until their episodes, in the order they began, hold `rows` transitions, and cuts those.

    Taking them in that order, not in the order they end, keeps short episodes from being over-represented. Rows that
    lead from a final state to a reset are no transitions and are dropped. The last episode is cut: marked truncated.

    Args:
        robot: whose simulator is made once per seed.
        policy: acts with stochastic actions; it knows the robot without what a variant adds.
        rows: transitions, exactly; at least two.
        seeds: of the simulators.
        generator: of the actions.
    """
    envs = SyncVectorEnv([robot.make] * len(seeds), autoreset_mode=AutoresetMode.NEXT_STEP)
    log = _Log(robot, len(seeds))
    seen = ROBOTS[robot.name].observation_dim
    observation, _ = envs.reset(seed=[*seeds])
    while log.usable_rows() <= rows:
        action = policy.act(torch.as_tensor(observation[:, :seen], dtype=torch.float32), False, generator).numpy()
        following, reward, terminated, truncated, _ = envs.step(action)
        log.append(
            observations=observation,
            actions=action,
            rewards=reward,
            next_observations=following,
            terminated=terminated,
            truncated=truncated & ~terminated,
        )
        observation = following
    envs.close()
    return log.cut(rows)


def empty_columns(robot: Robot, shape: tuple[int, ...]) -> Columns:
    """Columns of that leading shape, to be filled."""
    widths = {"observations": (robot.observation_dim,), "actions": (robot.action_dim,)}
    widths["next_observations"] = widths["observations"]
    kinds = {"terminated": bool, "truncated": bool}
    return {name: np.empty(shape + widths.get(name, ()), kinds.get(name, np.float32)) for name in COLUMNS}


@dataclass
class _Trace:
    """An episode: the steps from `start` to `stop` of one environment; `stop` is None while it runs."""

    environment: int
    start: int
    stop: int | None = None


@dataclass
class _Log:
    """Steps of E environments in arrays (T, E, ...) that grow, and the episodes in them.

    Attributes:
        robot: gives the columns their widths.
        environments: E.
        steps: T so far.
        episodes: in the order they began.
        finished: leading episodes that are over.
        finished_rows: transitions in those.
    """

    robot: Robot
    environments: int
    steps: int = 0
    episodes: list[_Trace] = field(default_factory=list)
    finished: int = 0
    finished_rows: int = 0

    def __post_init__(self) -> None:
        self.columns = empty_columns(self.robot, (1_024, self.environments))
        self.running = [_Trace(environment, 0) for environment in range(self.environments)]
        self.episodes += self.running

    def append(self, **step: np.ndarray) -> None:
        """One step of all environments: arrays (E, ...) under the names in `COLUMNS`."""
        if self.steps == len(self.columns["rewards"]):
            self.columns = {name: np.concatenate([rows, np.empty_like(rows)]) for name, rows in self.columns.items()}
        for name, rows in self.columns.items():
            rows[self.steps] = step[name]
        self.steps += 1
        for environment, trace in enumerate(self.running):
            if trace.stop is not None:  # this step was the automatic reset, which is no transition: no episode has it
                self.running[environment] = _Trace(environment, self.steps)
                self.episodes.append(self.running[environment])
            elif step["terminated"][environment] or step["truncated"][environment]:
                trace.stop = self.steps

    def usable_rows(self) -> int:
        """Transitions in the finished episodes up to the first running one, and in that one, which can still be cut."""
        while self.finished < len(self.episodes) and (stop := self.episodes[self.finished].stop) is not None:
            self.finished_rows += stop - self.episodes[self.finished].start
            self.finished += 1
        running = self.steps - self.episodes[self.finished].start if self.finished < len(self.episodes) else 0
        return self.finished_rows + running

    def cut(self, rows: int) -> Columns:
        """The first `rows` transitions, of at least one more; an episode that loses its end is truncated there."""
        taken = {name: np.empty((rows, *values.shape[2:]), values.dtype) for name, values in self.columns.items()}
        begin = 0
        for trace in self.episodes:
            count = min((self.steps if trace.stop is None else trace.stop) - trace.start, rows - begin)
            if rows - begin - count == 1:  # a lone row is no episode: leave two for the next
                count -= 1
            if count == 0:
                break
            for name, values in self.columns.items():
                taken[name][begin : begin + count] = values[trace.start : trace.start + count, trace.environment]
            begin += count
            taken["truncated"][begin - 1] = not taken["terminated"][begin - 1]
        assert begin == rows, f"an episode of one step left {rows - begin} of {rows} rows empty"
        return taken
