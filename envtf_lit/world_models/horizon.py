"""How far a world model can be trusted: open-loop and teacher-forced errors on recorded trajectories.

Training selects its model with `open_loop_error` and the evaluate stage reports `horizon_report`; both rest on the same
`forecast` and `nmse`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from envtf_lit.data.columns import column_blocks, moments
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.errors import UserError
from envtf_lit.world_models.interface import Mode, Prediction, WorldModel
from envtf_lit.world_models.normaliser import CONSTANT

THRESHOLDS = (0.01, 0.1)
HORIZONS = (1, 5, 10, 50, 100, 500, 1000)
EXPLODED = 10.0  # nmse beyond which a rollout has left anything that the data holds
FEWEST = 5  # trajectories that a quartile is drawn from
SMALLEST, LARGEST = 1e-8, 1e8  # curves of errors are drawn on a logarithmic axis, within these


@dataclass(frozen=True, eq=False)
class Scale:
    """The units errors are measured in: z-scores by the training data's statistics.

    Attributes:
        mean, std: (S + 1,) of the observations and, last, the reward.
        live: (S + 1,) bool, dimensions whose std is at least 1e-6.
    """

    mean: Tensor
    std: Tensor
    live: Tensor

    @classmethod
    def of(cls, training: OfflineDataset, device: torch.device | str = "cpu") -> "Scale":
        """Statistics of the training data, accumulated in float64."""
        mean, std = moments(
            torch.as_tensor(np.column_stack([training.observations[rows], training.rewards[rows]]))
            for rows in column_blocks(training.observations)
        )
        std = std.float().to(device)
        return cls(mean.float().to(device), std, std >= CONSTANT)


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
    rows = torch.argsort(trajectories.lengths, descending=True, stable=True)
    running = trajectories.valid.sum(0).tolist()  # trajectories that last until each step
    mean = torch.zeros_like(trajectories.targets)
    std, tail = torch.zeros_like(trajectories.targets), None
    first, none = trajectories.observations[rows, :1], trajectories.actions[rows, :0]
    state = model.init(first, none, torch.ones_like(trajectories.lengths))
    for t in range(trajectories.actions.shape[1]):
        if running[t] <= len(rows) // 2:  # most have ended: go on with the others
            rows = rows[: running[t]]
            state = model.gather(state, torch.arange(len(rows), device=rows.device))
        if t > 0 and (feedback == "recorded" or t <= history):
            state = model.observe(state, trajectories.observations[rows, t])
        state, prediction = model.step(state, trajectories.actions[rows, t], mode=mode, generator=generator)
        sampled = torch.cat([prediction.observation, prediction.reward[:, None]], dim=-1)
        mean[rows, t] = prediction.mean if mode == "mean" else sampled
        std[rows, t], tail = _total_std(prediction), prediction.tail
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


def open_loop_error(model: WorldModel, trajectories: Trajectories, scale: Scale) -> float:
    """Geometric mean of the open-loop nmse over all steps: the number models are selected by.

    Errors of a rollout span orders of magnitude; the arithmetic mean would be that of its few worst steps. Each error
    is bounded to [1e-8, 1e4], so that one explosion counts much, not infinitely.
    """
    error = nmse(forecast(model, trajectories, feedback="imagined").mean, trajectories, scale)
    return float(10.0 ** error[trajectories.valid].clamp(1e-8, 1e4).log10().mean())


@dataclass(frozen=True)
class Steps:
    """How many steps trajectories stay within an error threshold.

    Attributes:
        mean: restricted mean; a trajectory that ends within the threshold counts with its length.
        standard_error: of that mean.
        median: over trajectories.
        censored: share of trajectories that end within the threshold.
    """

    mean: float
    standard_error: float
    median: float
    censored: float

    @classmethod
    def within(cls, error: Tensor, lengths: Tensor, threshold: float) -> "Steps":
        """Of trajectories with these errors, as `steps_within` takes them."""
        steps, censored = steps_within(error, lengths, threshold)
        values = steps.double().cpu().numpy()
        spread = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
        return cls(float(values.mean()), float(spread), float(np.median(values)), float(censored.double().mean()))


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


def error_quartiles(error: Tensor, lengths: Tensor) -> dict[str, np.ndarray]:
    """Quartiles of the errors (B, T) by step, over the trajectories that last so long, while five or more do.

    Returns:
        Columns (H,) `step`, `lower`, `median`, `upper`, bounded to [1e-8, 1e8], and `trajectories`.
    """
    values, lasting = error.cpu().numpy(), lengths.cpu().numpy()
    last = int(np.sort(lasting)[-min(FEWEST, len(lasting))])
    quartiles, counts = np.empty((last, 3)), np.empty(last, np.int64)
    for h in range(1, last + 1):
        running = np.clip(values[lasting >= h, h - 1], SMALLEST, LARGEST)
        quartiles[h - 1], counts[h - 1] = np.quantile(running, (0.25, 0.5, 0.75)), len(running)
    lower, median, upper = quartiles.T
    return dict(step=np.arange(1, last + 1), lower=lower, median=median, upper=upper, trajectories=counts)


@dataclass(frozen=True, eq=False)
class HorizonReport:
    """Errors of a model along whole held-out episodes.

    Attributes:
        nmse_one_step: mean teacher-forced nmse over all steps.
        open_loop, teacher_forced: by threshold.
        median_nmse: open loop, by step h, over the trajectories that last so long.
        explosion_rate: share of trajectories whose open-loop nmse exceeds 10 or is not finite at some step.
        trajectories: what was forecast.
        imagined, taught: the open-loop and the teacher-forced forecast.
        open_loop_nmse, teacher_forced_nmse: (B, T), meaningless in the padding.
    """

    nmse_one_step: float
    open_loop: dict[float, Steps]
    teacher_forced: dict[float, Steps]
    median_nmse: dict[int, float]
    explosion_rate: float
    trajectories: Trajectories
    imagined: Forecast
    taught: Forecast
    open_loop_nmse: Tensor
    teacher_forced_nmse: Tensor


def horizon_report(
    model: WorldModel, trajectories: Trajectories, scale: Scale, *, thresholds: Sequence[float] = THRESHOLDS
) -> HorizonReport:
    """Forecasts every trajectory open loop and teacher-forced and sums up the errors."""
    imagined = forecast(model, trajectories, feedback="imagined")
    taught = forecast(model, trajectories, feedback="recorded")
    free, forced = (nmse(run.mean, trajectories, scale) for run in (imagined, taught))
    lengths, valid = trajectories.lengths, trajectories.valid
    reached = [h for h in HORIZONS if bool((lengths >= h).any())]
    return HorizonReport(
        nmse_one_step=float(forced[valid].mean()),
        open_loop={threshold: Steps.within(free, lengths, threshold) for threshold in thresholds},
        teacher_forced={threshold: Steps.within(forced, lengths, threshold) for threshold in thresholds},
        median_nmse={h: float(np.median(free[lengths >= h, h - 1].cpu().numpy())) for h in reached},
        explosion_rate=float(((free > EXPLODED) & valid).any(1).double().mean()),
        trajectories=trajectories,
        imagined=imagined,
        taught=taught,
        open_loop_nmse=free,
        teacher_forced_nmse=forced,
    )
