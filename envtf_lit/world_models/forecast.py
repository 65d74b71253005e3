"""Open-loop and teacher-forced forecasts of a world model along recorded episodes, and their errors."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.errors import UserError
from envtf_lit.world_models.interface import Mode, Prediction, WorldModel
from envtf_lit.world_models.unroll import unroll


@dataclass(frozen=True, eq=False)
class Scale:
    """The units errors are measured in: z-scores by the training data's statistics.

    Attributes:
        mean, std: (S + 1,) of the observations and, last, the reward.
        live: (S + 1,) bool, dimensions that are not constant (`Moments.live`).
    """

    mean: Tensor
    std: Tensor
    live: Tensor

    @classmethod
    def of(cls, training: OfflineDataset, device: torch.device | str = "cpu") -> "Scale":
        """Statistics of the training data, accumulated in float64."""
        found = training.statistics.observations + training.statistics.rewards
        return cls(found.mean.float().to(device), found.std.float().to(device), found.live.to(device))


@dataclass(frozen=True, eq=False)
class Trajectories:
    """B recorded stretches of up to T steps, none crossing an episode's end; rows are right-padded with zeros.

    Attributes:
        observations: (B, T, S).
        actions: (B, T, A).
        targets: (B, T, S + 1), the next observation and, last, the reward.
        lengths: (B,) int64, valid steps.
    """

    observations: Tensor
    actions: Tensor
    targets: Tensor
    lengths: Tensor

    @property
    def valid(self) -> Tensor:
        """(B, T) bool, False in the padding."""
        return torch.arange(self.actions.shape[1], device=self.lengths.device) < self.lengths[:, None]

    def later(self, start: int) -> "Trajectories":
        """Those that last longer than `start` steps, without their first `start`."""
        columns = (self.observations, self.actions, self.targets)
        shorter = Trajectories(*(column[:, start:] for column in columns), lengths=self.lengths - start)
        return shorter.select(self.lengths > start)

    def select(self, rows: Tensor) -> "Trajectories":
        """Those of some rows: indices, or (B,) bool."""
        return Trajectories(*(column[rows] for column in (self.observations, self.actions, self.targets, self.lengths)))

    def to(self, device: torch.device | str) -> "Trajectories":
        """The same on another device."""
        columns = (self.observations, self.actions, self.targets, self.lengths)
        return Trajectories(*(column.to(device) for column in columns))


def _cut(dataset: OfflineDataset, starts: np.ndarray, lengths: np.ndarray) -> Trajectories:
    offsets = np.arange(lengths.max())
    valid = torch.from_numpy(offsets < lengths[:, None]).unsqueeze(-1)  # (B, T, 1)
    rows = np.minimum(starts[:, None] + offsets, len(dataset) - 1)  # (B, T)
    targets = np.concatenate([dataset.next_observations[rows], dataset.rewards[rows][..., None]], axis=-1)
    columns = (dataset.observations[rows], dataset.actions[rows], targets)
    padded = (torch.from_numpy(column).float().where(valid, torch.zeros(())) for column in columns)
    return Trajectories(*padded, lengths=torch.from_numpy(lengths))


def whole_episodes(dataset: OfflineDataset, count: int, *, seed: int) -> Trajectories:
    """Up to `count` whole episodes drawn without replacement, from their first step."""
    number = len(dataset.episode_starts)
    chosen = np.sort(np.random.default_rng(seed).permutation(number)[:count])
    return _cut(dataset, dataset.episode_starts[chosen], dataset.episode_lengths[chosen])


def segments(dataset: OfflineDataset, count: int, length: int, *, seed: int, whole: bool = False) -> Trajectories:
    """`count` stretches of `length` steps from rows drawn at random.

    Where the episode ends they have fewer steps, unless `whole` leaves out the rows that have fewer to follow.

    Raises:
        UserError: no episode is so long.
    """
    left = dataset.episode_ends[dataset.episode_index] - np.arange(len(dataset))
    rows = np.flatnonzero(left >= (length if whole else 1))
    if len(rows) == 0:
        raise UserError(f"No episode has the {length} steps that are asked for: take data with longer ones.")
    starts = rows[np.random.default_rng(seed).integers(len(rows), size=count)]
    return _cut(dataset, starts, np.minimum(left[starts], length))


@dataclass(frozen=True, eq=False)
class Forecast:
    """Predictions along trajectories, in the data's units; what stands in the padding means nothing.

    Attributes:
        mean: (B, T, S + 1) of the next observation and, last, the reward; their draws, if sampled.
        std: (B, T, S + 1), `sqrt(aleatoric^2 + epistemic^2)`, of that one step given the state it started from; with a
            tail, of the Gaussian that has the same 90 % interval.
        tail: (S + 1,) of the predictive distributions (`world_models.tails`); None: they are Gaussian.
    """

    mean: Tensor
    std: Tensor
    tail: Tensor | None = None


@torch.no_grad()
def forecast(
    model: WorldModel,
    trajectories: Trajectories,
    *,
    feedback: Literal["imagined", "recorded"],
    history: int = 0,
    mode: Mode = "mean",
    generator: torch.Generator | None = None,
) -> Forecast:
    """Runs the model along the recorded actions from the first recorded state alone (context 1).

    Args:
        model: any world model, in eval mode, on the trajectories' device.
        trajectories: what really happened.
        feedback: `imagined` feeds each predicted state back (open loop, no clipping); `recorded` shows the model the
            true state before every step, so that it predicts one step ahead with the true history (teacher forcing).
        history: leading steps in which the model is shown the true states in any case; the open loop begins behind
            them, at the true state, with this much history.
        mode: predictions are the mean's, or draws from the predictive distribution.
        generator: of those draws.
    """
    order = torch.argsort(trajectories.lengths, descending=True, stable=True)
    running = trajectories.valid.sum(0).tolist()  # trajectories that last until each step
    mean, std = torch.zeros_like(trajectories.targets), torch.zeros_like(trajectories.targets)
    first, none = trajectories.observations[order, :1], trajectories.actions[order, :0]
    state, tail = model.init(first, none, torch.ones_like(trajectories.lengths)), None

    def act(t: int, rows: Tensor, observation: Tensor) -> Tensor:
        return trajectories.actions[order[rows], t]

    def select(t: int, rows: Tensor) -> Tensor | None:
        half_ended = running[t] <= len(rows) // 2  # go on with the others
        return torch.arange(running[t], device=rows.device) if half_ended else None

    def observe(t: int, rows: Tensor) -> Tensor | None:
        shown = t > 0 and (feedback == "recorded" or t <= history)
        return trajectories.observations[order[rows], t] if shown else None

    length = trajectories.actions.shape[1]
    for step in unroll(model, state, act, length, mode=mode, select=select, observe=observe, generator=generator):
        rows, prediction = order[step.rows], step.prediction
        sampled = torch.cat([prediction.observation, prediction.reward[:, None]], dim=-1)
        mean[rows, step.index] = prediction.mean if mode == "mean" else sampled
        std[rows, step.index], tail = _total_std(prediction), prediction.tail
    return Forecast(mean, std, tail)


def _total_std(prediction: Prediction) -> Tensor:
    if prediction.epistemic is None:
        return prediction.aleatoric
    return (prediction.aleatoric.square() + prediction.epistemic.square()).sqrt()


def nmse(mean: Tensor, trajectories: Trajectories, scale: Scale) -> Tensor:
    """(B, T) `mean over live dimensions of ((predicted - recorded) / std)^2`; infinite where a prediction isn't finite.

    Entries in the padding mean nothing: mask them with `trajectories.valid`.
    """
    error = (mean - trajectories.targets)[..., scale.live] / scale.std[scale.live]
    return error.double().square().mean(-1).nan_to_num(nan=torch.inf, posinf=torch.inf)


def steps_within(error: Tensor, lengths: Tensor, threshold: float) -> tuple[Tensor, Tensor]:
    """`L = min{h >= 1: nmse_h > threshold} - 1` of each trajectory, or its length where no step exceeds.

    Args:
        error: (B, T), nmse_h in column h - 1.
        lengths: (B,) valid steps.
        threshold: of the nmse.

    Returns:
        (B,) int64 steps and (B,) bool, True where censored by the trajectory's end.
    """
    columns = torch.arange(error.shape[1], device=error.device)
    exceeds = (error > threshold) & (columns < lengths[:, None])
    first = torch.where(exceeds.any(1), exceeds.int().argmax(1), lengths)
    return first, ~exceeds.any(1)


def median_steps_within(error: Tensor, lengths: Tensor, threshold: float) -> int:
    """The most steps within which at least half of all trajectories stay, had none of them ended (Kaplan, Meier 1958).

    An episode's end says nothing about the steps that would have followed. Arguments as of `steps_within`; where too
    few exceed the threshold it is the longest trajectory's length.
    """
    steps, censored = steps_within(error, lengths, threshold)
    within = 1.0
    for h in range(1, int(lengths.max()) + 1):
        under_way = int((steps >= h - 1).sum() - ((steps == h - 1) & censored).sum())
        failed = int(((steps == h - 1) & ~censored).sum())
        within *= 1.0 - failed / max(1, under_way)
        if within < 0.5 - 1e-9:  # rounding
            return h - 1
    return int(lengths.max())


def open_loop_error(model: WorldModel, trajectories: Trajectories, scale: Scale) -> float:
    """Geometric mean of the open-loop nmse over all steps: the number models are selected by.

    Errors of a rollout span orders of magnitude; the arithmetic mean would be that of its few worst steps. Each error
    is bounded to [1e-8, 1e4], so that one explosion counts much, not infinitely.
    """
    error = nmse(forecast(model, trajectories, feedback="imagined").mean, trajectories, scale)
    return float(10.0 ** error[trajectories.valid].clamp(1e-8, 1e4).log10().mean())
