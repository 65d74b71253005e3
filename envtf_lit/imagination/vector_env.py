"""Many imagined episodes side by side, in one pass of the world model a step: Gymnasium's vector form."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.errors import UserError
from envtf_lit.imagination.dream import Dream, DreamOptions, Episode
from envtf_lit.imagination.env import RENDERING, spaces
from envtf_lit.robots.silhouette import silhouette_of
from envtf_lit.world_models.interface import WorldModel


class ImaginedVectorEnv(VectorEnv):
    """N imagined episodes, which come out as those of N `ImaginedEnv` under the same seeds, bit for bit.

    Args:
        world_model, dataset, task, action_low, action_high, render_mode, options: as of `ImaginedEnv`.
        num_envs: N.
        autoreset_mode: Gymnasium's: an episode that is over begins anew at the next step (`NEXT_STEP`), within the same
            one (`SAME_STEP`; its last observation and info are `final_obs` and `final_info`), or where
            `reset(options={"reset_mask": (N,) bool})` says so (`DISABLED`).

    Raises:
        UserError: as of `ImaginedEnv`, or there is no such mode, or no episode.
    """

    def __init__(
        self,
        world_model: str | Path | WorldModel,
        dataset: str | Path | OfflineDataset | None = None,
        *,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
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
        if num_envs < 1:
            raise UserError(f"num_envs is {num_envs}: take 1 or more.")
        self.num_envs, self.render_mode = num_envs, render_mode
        self.mode = _mode(autoreset_mode)
        self.metadata = RENDERING | {"autoreset_mode": self.mode}
        self.single_observation_space, self.single_action_space = spaces(self.dream)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._episodes = [Episode(seeding.np_random()[0]) for _ in range(num_envs)]
        self._silhouette = None if render_mode is None else silhouette_of(self.dream.robot)
        self._positions = [np.zeros(0)] * num_envs
        self._begun = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """See `gymnasium.vector.VectorEnv.reset`; episode i has the seed `seed + i`, or the i-th of a list.

        Args:
            seed: None goes on with the generators there are.
            options: `history`, as of `ImaginedEnv`, for all; `reset_mask` (N,) bool, which of them begin anew.

        Raises:
            UserError: a mask or a list of seeds of another size, or as of `ImaginedEnv.reset`.
        """
        seeds = (
            [None if seed is None else seed + i for i in range(self.num_envs)] if isinstance(seed, int | None) else seed
        )
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool or len(seeds) != self.num_envs:
            raise UserError(
                f"There are {self.num_envs} imagined episodes: give a reset_mask of as many truth values, and as many "
                "seeds or one."
            )
        for i, (own, chosen) in enumerate(zip(seeds, mask, strict=True)):
            if chosen and own is not None:
                self._episodes[i].random = seeding.np_random(own)[0]
            if chosen or not self._begun:
                self._begin(i, (options or {}).get("history"))
        self._begun = True
        return self._observations(), {}

    def _begin(self, i: int, history: Any = None) -> None:
        observation = self.dream.begin(self._episodes[i], history)
        if self._silhouette is not None:
            self._positions[i] = self._silhouette.start(observation)

    def _observations(self) -> np.ndarray:
        return np.stack([episode.observations[-1] for episode in self._episodes])

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """See `gymnasium.vector.VectorEnv.step`.

        Raises:
            UserError: nothing has begun, actions of another shape or outside their range, or an episode is over and
                the mode is `DISABLED`.
        """
        if not self._begun:
            raise UserError("No imagined episode has begun: reset() the environment first.")
        actions = np.asarray(actions, np.float32)
        if actions.shape != self.action_space.shape:
            raise UserError(f"The actions have shape {actions.shape}, and there must be {self.action_space.shape}.")
        over = np.array([episode.over for episode in self._episodes])
        if over.any() and self.mode == AutoresetMode.DISABLED:
            raise UserError(
                f"Episode {int(over.argmax())} is over and nothing resets it: reset(options={{'reset_mask': …}}) first."
            )
        going = np.flatnonzero(~over)
        taken = [self.dream.checked(actions[i]) for i in going]
        found = dict(zip(going.tolist(), self.dream.step([self._episodes[i] for i in going], taken), strict=True))
        rewards, infos = np.zeros(self.num_envs), {}
        ends = np.zeros((2, self.num_envs), bool)
        for i in range(self.num_envs):
            if i not in found:  # over since the step before
                self._begin(i)
                continue
            outcome = found[i]
            rewards[i], ends[:, i], info = outcome.reward, (outcome.terminated, outcome.truncated), outcome.info
            if self._silhouette is not None:
                self._positions[i] = self._silhouette.follow(self._positions[i], outcome.observation)
            if ends[:, i].any() and self.mode == AutoresetMode.SAME_STEP:
                infos = self._add_info(infos, {"final_obs": outcome.observation, "final_info": info}, i)
                self._begin(i)
                info = {}
            infos = self._add_info(infos, info, i)
        return self._observations(), rewards, ends[0], ends[1], infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture of each robot; None without a render mode."""
        if self._silhouette is None:
            return None
        return tuple(self._silhouette.picture(position) for position in self._positions)


def _mode(mode: AutoresetMode | str) -> AutoresetMode:
    """Gymnasium's mode of that name or value."""
    known = {**{m.name: m for m in AutoresetMode}, **{m.value: m for m in AutoresetMode}}
    found = known.get(mode) if isinstance(mode, str) else mode
    if not isinstance(found, AutoresetMode):
        raise UserError(f"autoreset_mode is {mode!r}: choose from {', '.join(m.name for m in AutoresetMode)}.")
    return found
