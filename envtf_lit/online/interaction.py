"""A policy in environments that step together, from which a run that was interrupted can go on to the same bits."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torch import Tensor

from envtf_lit.errors import UserError
from envtf_lit.robots.tasks import Robot

Rows = dict[str, Tensor]


class Interaction:
    """E environments, each in an episode of its own.

    Every episode begins with a seed of its own, made of the run's, the environment's number, and how many episodes it
    had before. Where it stands is therefore known by the actions since: to continue, they are played again.

    Attributes:
        observations: (E, S) float32, where the environments stand.
        steps: taken so far, of all environments together.
        finished: returns of the episodes that ended since the list was emptied last.

    Args:
        robot: whose environment is made E times.
        environments: E.
        seed: of all episodes' beginnings.
    """

    def __init__(self, robot: Robot, environments: int, seed: int) -> None:
        self.robot, self.seed, self.steps = robot, seed, 0
        self.envs = SyncVectorEnv([robot.make] * environments, autoreset_mode=AutoresetMode.DISABLED)
        self.begun = np.zeros(environments, np.int64)  # episodes, of each environment
        self.taken: list[list[np.ndarray]] = [[] for _ in range(environments)]  # actions since, (A,) each
        self.earned = np.zeros(environments)
        self.finished: list[float] = []
        self.observations = self._begin(np.ones(environments, bool))

    @property
    def environments(self) -> int:
        """E."""
        return len(self.begun)

    def step(self, act: Callable[[Tensor], Tensor]) -> Rows:
        """One step of each environment, which begins anew where its episode is over.

        Args:
            act: observations (E, S) to actions (E, A), on the CPU.

        Returns:
            The transitions: `observations`, `actions`, `rewards`, `next_observations`, `terminated`, `truncated`,
            (E, …) each.

        Raises:
            UserError: an action is not finite.
        """
        observations = torch.tensor(self.observations)  # a copy: matrix products may round by where NumPy's memory lies
        actions = act(observations)
        if not actions.isfinite().all():
            raise UserError(
                f"The policy asks for the action {actions.tolist()} after {self.steps} steps: its training diverged, "
                "so lower actor_learning_rate."
            )
        following, rewards, terminated, truncated, _ = self.envs.step(actions.numpy())
        following = following.astype(np.float32)
        self.earned += rewards
        for taken, action in zip(self.taken, actions.numpy(), strict=True):
            taken.append(action)
        rows = dict(
            observations=observations,
            actions=actions,
            rewards=torch.from_numpy(rewards.astype(np.float32)),
            next_observations=torch.from_numpy(following),
            terminated=torch.from_numpy(terminated.copy()),
            truncated=torch.from_numpy(truncated & ~terminated),
        )
        over = terminated | truncated
        self.finished += self.earned[over].tolist()
        self.observations = self._begin(over) if over.any() else following
        self.steps += self.environments
        return rows

    def state_dict(self) -> dict[str, Any]:
        """Where it stands, as tensors and numbers."""
        taken = [torch.from_numpy(np.array(actions, np.float32)) for actions in self.taken]
        return dict(begun=self.begun.tolist(), taken=taken, steps=self.steps, stands=torch.tensor(self.observations))

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes there, by the actions that were taken.

        Raises:
            UserError: the same actions lead elsewhere, or there are other environments.
        """
        if len(state["begun"]) != self.environments:
            raise UserError(
                f"The checkpoint is of {len(state['begun'])} environments, and --data.environments is "
                f"{self.environments}: continue with as many."
            )
        self.begun[:] = np.array(state["begun"]) - 1
        self.observations, self.steps = self._begin(np.ones(self.environments, bool)), int(state["steps"])
        for number, actions in enumerate(state["taken"]):
            for action in actions.numpy():
                observation, reward, *_ = self.envs.envs[number].step(action)
                self.observations[number] = observation
                self.earned[number] += float(reward)
                self.taken[number].append(action)
        if not np.array_equal(self.observations, state["stands"].numpy()):
            raise UserError(
                f"{self.robot.env_id} does not come to the same place by the same actions, so that a run in it cannot "
                "be continued: train anew, or start from what was published with --model.init_from."
            )

    def _begin(self, which: np.ndarray) -> np.ndarray:
        """Begins an episode in each environment of a mask (E,); returns where all stand, (E, S)."""
        seeds = [self._seed(number) if begins else None for number, begins in enumerate(which)]
        observations, _ = self.envs.reset(seed=seeds, options={"reset_mask": which})
        self.begun[which] += 1
        self.earned[which] = 0.0
        for number in np.flatnonzero(which):
            self.taken[number] = []
        return observations.astype(np.float32)

    def _seed(self, number: int) -> int:
        sequence = np.random.SeedSequence([self.seed, number, int(self.begun[number])])
        return int(sequence.generate_state(1)[0])
