"""What the imagined environments have in common: a world model that many episodes step through, each its own.

Episodes begin and end at different times, so each keeps its own history, and the model reads the last steps of it anew
at every step, as in training. It is always asked for whole blocks of rows: a matrix product may round a row differently
in a batch of another size, and an episode must not depend on those beside it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.sources.files import load_dataset
from envtf_lit.errors import UserError
from envtf_lit.robots.tasks import Robot, get_task
from envtf_lit.robots.termination import never_terminated
from envtf_lit.world_models.interface import Mode, Prediction, WorldModel
from envtf_lit.world_models.store import load_world_model
from envtf_lit.world_models.termination_head import termination_rule
from envtf_lit.world_models.transformer import EnvironmentTransformer
from envtf_lit.world_models.uncertainty.tails import stretch
from envtf_lit.world_models.unroll import lost

# rows of a block: any number of columns then makes a multiple of what a CPU's vector instructions take at a time, so
# that no row is left over for other instructions
ROWS = 32
SLACK = 1e-4  # of the action range, by which rounding may leave it
MAX_STEPS = 1_000  # of an episode, where no robot says otherwise


@dataclass(eq=False)
class Episode:
    """One episode under way.

    Attributes:
        random: of its first state and all that is drawn in it.
        observations: the last ones, each (S,), the present one at the end.
        actions: those between them, each (A,).
        steps: taken.
        over: it has ended.
    """

    random: np.random.Generator
    observations: list[np.ndarray] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    steps: int = 0
    over: bool = True


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a step led to, in Gymnasium's words."""

    observation: np.ndarray
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


@dataclass(frozen=True)
class DreamOptions:
    """How episodes are imagined.

    Attributes:
        mode: each outcome is drawn about the predicted mean, as wide as the whole predicted spread (`sample`), or is
            that mean (`mean`).
        history: steps of its past that the model is shown at most; None: as many as it looks back.
        starts: episodes begin at rows of the log drawn at random (`rows`), or where the log's own begin (`episodes`).
        max_steps: after which an episode is truncated; None: the robot's, or 1,000.
        penalty: what a unit of uncertainty u costs, in the reward's own units.
        novelty_limit: an episode is truncated, its trust lost, where the model's epistemic variance passes this
            multiple of its 0.999 quantile over the training data; None trusts it everywhere.
    """

    mode: Literal["mean", "sample"] = "sample"
    history: int | None = None
    starts: Literal["rows", "episodes"] = "rows"
    max_steps: int | None = None
    penalty: float = 0.0
    novelty_limit: float | None = 1.0


class Dream:
    """A world model, the log that episodes begin in, and the rules by which they end. It holds no episode itself.

    Args:
        world_model: folder, or any world model on the CPU.
        dataset: file or dataset; None where every `reset` brings a history.
        task: whose robot it is; None takes the dataset's.
        action_low, action_high: (A,) the action range where neither dataset nor task tell it.
        options: see there.

    Attributes:
        robot: or None where no task is known.
        low, high: (A,) float32, the action range.

    Raises:
        UserError: no world model or dataset there, or sizes of model, dataset and robot that differ; an unknown task;
            no action range; an option out of range.
    """

    def __init__(
        self,
        world_model: str | Path | WorldModel,
        dataset: str | Path | OfflineDataset | None = None,
        *,
        task: str | None = None,
        action_low: Sequence[float] | None = None,
        action_high: Sequence[float] | None = None,
        options: DreamOptions,
    ) -> None:
        folder = Path(world_model) if isinstance(world_model, str | Path) else None
        self.model: WorldModel = load_world_model(folder) if folder is not None else world_model  # pyright: ignore[reportAttributeAccessIssue]
        self.dataset = load_dataset(dataset) if isinstance(dataset, str | Path) else dataset
        task = self.dataset.task if task is None and self.dataset is not None else task
        self.robot: Robot | None = None if task is None else get_task(task).robot
        self.options, cpu = _checked(options), torch.device("cpu")
        self.terminated = never_terminated if task is None else get_task(task).robot.terminated
        if task is None and folder is not None:
            self.terminated = termination_rule(None, folder, cpu)
        self.history = _look_back(self.model) - 1 if options.history is None else options.history
        limit = MAX_STEPS if self.robot is None else self.robot.max_episode_steps
        self.max_steps = limit if options.max_steps is None else options.max_steps
        self._check_sizes()
        self.low, self.high = self._action_range(action_low, action_high)

    def _check_sizes(self) -> None:
        mine = self.model.observation_dim, self.model.action_dim
        for name, thing in (("the dataset", self.dataset), ("the task's robot", self.robot)):
            if thing is not None and (thing.observation_dim, thing.action_dim) != mine:
                raise UserError(
                    f"The world model has observations of size {mine[0]} and actions of size {mine[1]}, and {name} "
                    f"{thing.observation_dim} and {thing.action_dim}: take a model that was trained on this robot."
                )

    def _action_range(self, low: Sequence[float] | None, high: Sequence[float] | None) -> tuple[np.ndarray, np.ndarray]:
        size = self.model.action_dim
        if low is not None and high is not None:
            found = np.asarray(low, np.float32), np.asarray(high, np.float32)
        elif self.dataset is not None:
            found = self.dataset.action_low, self.dataset.action_high
        elif self.robot is not None:
            limit = np.full(size, self.robot.action_limit, np.float32)
            found = -limit, limit
        else:
            raise UserError("Nothing tells the action range: give a dataset, a task, or action_low and action_high.")
        if any(bound.shape != (size,) for bound in found) or not (found[0] < found[1]).all():
            raise UserError(
                f"The action range is {found[0].tolist()} to {found[1].tolist()}, and actions are of size {size}: give "
                "a low and a higher limit for each of their dimensions."
            )
        return found

    def begin(self, episode: Episode, history: Mapping[str, Any] | None = None) -> np.ndarray:
        """Begins an episode in the log, or after a history; its first observation (S,).

        Args:
            episode: to begin anew.
            history: `observations` (T, S) and `actions` (T - 1, A) that led to the present, which is the last one.

        Raises:
            UserError: neither log nor history, or one of other sizes.
        """
        seen, done = self._drawn(episode.random) if history is None else self._given(history)
        episode.observations, episode.actions = _last(list(seen), self.history + 1), _last(list(done), self.history)
        episode.steps, episode.over = 0, False
        return episode.observations[-1].copy()

    def _drawn(self, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        if self.dataset is None:
            raise UserError(
                "An imagined episode begins in a log, and this environment has none: make it with a dataset, or "
                "reset(options={'history': {'observations': …, 'actions': …}})."
            )
        if self.options.starts == "episodes":
            row = int(self.dataset.episode_starts[random.integers(len(self.dataset.episode_starts))])
        else:
            row = int(random.integers(len(self.dataset)))
        first = max(int(self.dataset.episode_starts[self.dataset.episode_index[row]]), row - self.history)
        observations, actions = self.dataset.observations[first : row + 1], self.dataset.actions[first:row]
        return np.array(observations, np.float32), np.array(actions, np.float32)

    def _given(self, history: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        S, A = self.model.observation_dim, self.model.action_dim
        try:
            seen = np.asarray(history["observations"], np.float32)
            done = np.asarray(history.get("actions", np.zeros((0, A))), np.float32).reshape(-1, A)
        except (KeyError, TypeError, ValueError, AttributeError):
            raise UserError("A history is {'observations': (T, S), 'actions': (T - 1, A)}: give it so.") from None
        if seen.ndim != 2 or seen.shape[1] != S or len(done) != len(seen) - 1:
            raise UserError(
                f"The history has observations of shape {seen.shape} and {len(done)} actions, and the model wants "
                f"(T, {S}) and T - 1 of size {A}: the last observation is the present, which has no action yet."
            )
        if not (np.isfinite(seen).all() and np.isfinite(done).all()):
            raise UserError("The history holds a number that is not finite: leave out what was not measured.")
        return seen, done

    def checked(self, action: Any) -> np.ndarray:
        """An action (A,) of the environment's range, rounding taken off.

        Raises:
            UserError: another shape, or beyond the range.
        """
        try:
            taken = np.asarray(action, np.float32)
        except (TypeError, ValueError):
            taken = np.zeros(())
        if taken.shape != self.low.shape:
            raise UserError(
                f"The action has shape {taken.shape}, and this environment's have {self.low.shape}: give one number "
                "for each actuator."
            )
        slack = SLACK * (self.high - self.low)
        if not ((taken >= self.low - slack) & (taken <= self.high + slack)).all():
            raise UserError(
                f"The action {taken.tolist()} is outside its range {self.low.tolist()} to {self.high.tolist()}: "
                "clip it; the world model has seen no other."
            )
        return taken.clip(self.low, self.high)

    @torch.no_grad()
    def step(self, episodes: Sequence[Episode], actions: Sequence[np.ndarray]) -> list[Outcome]:
        """Takes one step of each of these episodes, none of which is over, with actions as `checked` gives them."""
        outcomes = []
        for start in range(0, len(episodes), ROWS):
            some, theirs = episodes[start : start + ROWS], actions[start : start + ROWS]
            p, value = self._predict(some, theirs)
            fell, gone = self.terminated(p.observation), lost(p, self.options.novelty_limit)
            for row, (episode, action) in enumerate(zip(some, theirs, strict=True)):
                novelty = {} if p.novelty is None else {"novelty": float(p.novelty[row])}
                told = {"uncertainty": float(p.uncertainty[row])} | novelty
                ends = bool(fell[row]), bool(gone[row])
                outcomes.append(self._advance(episode, action, value[row].numpy(), *ends, told))
        return outcomes

    def _predict(self, episodes: Sequence[Episode], actions: Sequence[np.ndarray]) -> tuple[Prediction, Tensor]:
        """Predictions of a whole block, their `observation` and `reward` as drawn, and both together (ROWS, S + 1)."""
        S, A, T = self.model.observation_dim, self.model.action_dim, self.history + 1
        seen, done = np.zeros((ROWS, T, S), np.float32), np.zeros((ROWS, T - 1, A), np.float32)
        action, noise = np.zeros((ROWS, A), np.float32), np.zeros((ROWS, S + 1), np.float32)
        lengths = np.ones(ROWS, np.int64)
        for row, (episode, taken) in enumerate(zip(episodes, actions, strict=True)):
            lengths[row] = number = len(episode.observations)
            seen[row, :number], action[row] = episode.observations, taken
            if number > 1:
                done[row, : number - 1] = episode.actions
            if self.options.mode == "sample":
                noise[row] = episode.random.standard_normal(S + 1, np.float32)
        state = self.model.init(*(torch.from_numpy(column) for column in (seen, done, lengths)))
        mode: Mode = "mean"  # with draws of each episode's own, so that it does not depend on those beside it
        _, p = self.model.step(state, torch.from_numpy(action), mode=mode)
        if self.options.mode == "mean":
            return p, torch.cat([p.observation, p.reward[:, None]], -1)
        spread = p.aleatoric if p.epistemic is None else (p.aleatoric.square() + p.epistemic.square()).sqrt()
        tail = torch.zeros(S + 1) if p.tail is None else p.tail
        value = p.mean + spread * stretch(torch.from_numpy(noise), tail)
        drawn = Prediction(**vars(p) | {"observation": value[:, :-1], "reward": value[:, -1]})
        return drawn, value

    def _advance(
        self, episode: Episode, action: np.ndarray, value: np.ndarray, fell: bool, gone: bool, told: dict[str, Any]
    ) -> Outcome:
        if not np.isfinite(value).all():  # nothing that is no number goes out: the state stays, and trust is lost
            value, fell, gone = np.append(episode.observations[-1], np.float32(0.0)), False, True
        episode.observations = _last([*episode.observations, value[:-1].copy()], self.history + 1)
        episode.actions = _last([*episode.actions, action], self.history)
        episode.steps += 1
        gone = gone and not fell
        truncated = gone or (episode.steps >= self.max_steps and not fell)
        episode.over = fell or truncated
        reward = float(value[-1])
        info = {"reward": reward, **told, "lost_trust": gone}
        return Outcome(value[:-1].copy(), reward - self.options.penalty * told["uncertainty"], fell, truncated, info)


def _last(items: list[np.ndarray], count: int) -> list[np.ndarray]:
    return items[max(0, len(items) - count) :]


def _look_back(model: WorldModel) -> int:
    """Steps that a model looks back, the present one among them."""
    return model.options.context if isinstance(model, EnvironmentTransformer) else 1


def _checked(options: DreamOptions) -> DreamOptions:
    """The options, none of them out of range."""
    for name, least in (("history", 0), ("max_steps", 1), ("penalty", 0), ("novelty_limit", 0)):
        value = getattr(options, name)
        if value is not None and not value >= least:
            raise UserError(f"{name} is {value}: take {least} or more.")
    for name, known in (("mode", ("mean", "sample")), ("starts", ("rows", "episodes"))):
        if getattr(options, name) not in known:
            raise UserError(f"{name} is {getattr(options, name)!r}: choose from {', '.join(known)}.")
    return options
