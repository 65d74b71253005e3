"""A world model as a Gymnasium environment: `gymnasium.make("envtf/Imagined-v0", world_model=…, dataset=…)`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.errors import UserError
from envtf_lit.imagination.dream import Dream, DreamOptions, Episode
from envtf_lit.robots.silhouette import silhouette_of
from envtf_lit.world_models.interface import WorldModel

RENDERING: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}


class ImaginedEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """Episodes that a world model imagines, stepped like any other environment.

    They begin in the log, or after `reset(options={"history": {"observations": (T, S), "actions": (T - 1, A)}})`, and
    end where the robot falls (terminated), after `max_steps`, or where trust is lost (both truncated). Every step's
    `info` has the model's own `reward` (the one returned is less the penalty), its `uncertainty`, its `novelty` where
    it has one (see `Prediction`), and `lost_trust`. What the model remembers lies here, not in the model, so that
    environments may share one.

    Args:
        world_model: folder, or any world model on the CPU.
        dataset: file or dataset that episodes begin in.
        task: whose robot it is; None takes the dataset's.
        action_low, action_high: (A,) the action range where neither dataset nor task tell it.
        render_mode: `rgb_array` draws the robot.
        options: fields of `DreamOptions`.

    Raises:
        UserError: as of `Dream`, or a picture is asked for and no robot known.
    """

    metadata = RENDERING

    def __init__(
        self,
        world_model: str | Path | WorldModel,
        dataset: str | Path | OfflineDataset | None = None,
        *,
        task: str | None = None,
        action_low: Sequence[float] | None = None,
        action_high: Sequence[float] | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        chosen = DreamOptions(**options)
        self.dream = Dream(
            world_model, dataset, task=task, action_low=action_low, action_high=action_high, options=chosen
        )
        self.observation_space, self.action_space = spaces(self.dream)
        self.render_mode = render_mode
        self._silhouette = None if render_mode is None else silhouette_of(self.dream.robot)
        self._episode = Episode(self.np_random)
        self._position = np.zeros(0)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """See `gymnasium.Env.reset`; `options` may hold a `history`.

        Raises:
            UserError: there is neither a log nor a history to begin in, or one of other sizes.
        """
        super().reset(seed=seed)
        self._episode.random = self.np_random
        observation = self.dream.begin(self._episode, (options or {}).get("history"))
        if self._silhouette is not None:
            self._position = self._silhouette.start(observation)
        return observation, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """See `gymnasium.Env.step`.

        Raises:
            UserError: the episode is over, or the action has another shape or is outside its range.
        """
        if self._episode.over:
            raise UserError("This imagined episode is over, or none has begun: reset() the environment first.")
        (found,) = self.dream.step([self._episode], [self.dream.checked(action)])
        if self._silhouette is not None:
            self._position = self._silhouette.follow(self._position, found.observation)
        return found.observation, found.reward, found.terminated, found.truncated, found.info

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The robot in its imagined pose, (240, 240, 3) uint8; None without a render mode."""
        return None if self._silhouette is None else self._silhouette.picture(self._position)


def spaces(dream: Dream) -> tuple[Box, Box]:
    """Observation and action space of one episode."""
    return Box(-np.inf, np.inf, (dream.model.observation_dim,), np.float32), Box(
        dream.low, dream.high, dtype=np.float32
    )
