"""Calibration of a world model's uncertainty: coverage, proper scores, out-of-distribution detection, rank correlation.

Aleatoric and epistemic spread together are measured by predictive intervals and proper scores on held-out episodes;
epistemic variance alone by how well it tells out-of-distribution state-action pairs from in-distribution ones; the
uncertainty u, by which imagined rewards are penalised, by its rank correlation with the true error, as MuJoCo tells it,
along the model's own rollouts.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.statistics import CONSTANT
from envtf_lit.errors import UserError
from envtf_lit.evaluation.horizon import LARGEST
from envtf_lit.evaluation.physics import Physics
from envtf_lit.imagination.histories import BranchPoints, Histories
from envtf_lit.imagination.rollouts import imagine
from envtf_lit.policy import Policy
from envtf_lit.world_models.forecast import Forecast, Scale, Trajectories
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.world_models.uncertainty.recalibration import fitted_factor_and_tail, normal_scores
from envtf_lit.world_models.uncertainty.tails import crps, half_width, log_density

FIRST_STEPS = 10  # of an episode: just after a reset robots are where they hardly ever are again


@dataclass(frozen=True)
class Coverage:
    """Share of outcomes inside central predictive intervals.

    Attributes:
        level: of the interval, in (0, 1): what an honest model covers.
        mean: over live dimensions and the reward.
        by_dimension: one number for each observation dimension and, last, the reward; None for constant dimensions.
    """

    level: float
    mean: float
    by_dimension: tuple[float | None, ...]


def coverage(teacher_forced: Forecast, trajectories: Trajectories, scale: Scale, level: float) -> Coverage:
    """Share of recorded outcomes inside the central `level` interval of each one-step prediction.

    Args:
        teacher_forced: the forecast of `horizon_report` that was shown the true past.
        trajectories: what was forecast.
        scale: says which dimensions are live.
        level: in (0, 1).
    """
    share = (normal_scores(teacher_forced, trajectories).abs() <= half_width(level)).double().mean(0)  # (S + 1,)
    live = scale.live.tolist()
    by_dimension = tuple(value if alive else None for value, alive in zip(share.tolist(), live, strict=True))
    return Coverage(level, float(share[scale.live].mean()), by_dimension)


def recalibrated(teacher_forced: Forecast, seen: Forecast, trajectories: Trajectories) -> Forecast:
    """A forecast with factors and tails that were fitted to another one of the same model, as the transformer has them.

    Args:
        teacher_forced: the forecast to be recalibrated.
        seen: the forecast that factors and tails are fitted to, of other episodes.
        trajectories: these episodes, as recorded.
    """
    factor, tail = fitted_factor_and_tail(normal_scores(replace(seen, tail=None), trajectories))
    return Forecast(teacher_forced.mean, teacher_forced.std * factor.sqrt().to(teacher_forced.std.dtype), tail)


@dataclass(frozen=True)
class ProperScores:
    """Scores that are least in expectation where the forecast is the true distribution; per live dimension and outcome.

    In z-scored units, at most 1e8.

    Attributes:
        nll: mean negative log-density.
        crps: continuous ranked probability score: the absolute error, less what an honest spread excuses.
    """

    nll: float
    crps: float


def proper_scores(teacher_forced: Forecast, trajectories: Trajectories, scale: Scale) -> ProperScores:
    """Scores of one-step predictions at the recorded outcomes, mean over live dimensions and the reward.

    Args:
        teacher_forced: the forecast of `horizon_report` that was shown the true past; a spread counts as at least 1e-6
            z-scored units.
        trajectories: what was forecast.
        scale: the units, and which dimensions are live.
    """
    columns = (trajectories.targets - teacher_forced.mean, teacher_forced.std)
    error, std = ((column[trajectories.valid] / scale.std)[:, scale.live].double() for column in columns)
    std = std.clamp(min=CONSTANT)
    z = error.nan_to_num(nan=math.inf) / std
    tail = torch.zeros_like(scale.std) if teacher_forced.tail is None else teacher_forced.tail
    tail = tail[scale.live].double()
    scores = std.log() - log_density(z, tail), std * crps(z, tail)
    return ProperScores(*(min(float(score.mean()), LARGEST) for score in scores))


@dataclass(frozen=True, eq=False)
class Points:
    """N state-action pairs, each with the real steps before it.

    Attributes:
        histories: N, each of which ends with the state of its pair.
        actions: (N, A) of the pairs.
    """

    histories: Histories
    actions: Tensor

    def to(self, device: torch.device | str) -> "Points":
        """The same on another device."""
        return Points(self.histories.to(device), self.actions.to(device))


def draw_points(dataset: OfflineDataset, count: int, *, history: int, seed: int) -> Points:
    """Up to `count` of a dataset's pairs, drawn without replacement, none from an episode's first 10 steps.

    Args:
        dataset: where they come from.
        count: of pairs.
        history: real steps before each, or fewer where the episode has no more.
        seed: of the draw.

    Raises:
        UserError: no episode has more than 10 steps.
    """
    late = np.flatnonzero(np.arange(len(dataset)) - dataset.episode_starts[dataset.episode_index] >= FIRST_STEPS)
    if len(late) == 0:
        raise UserError(f"No episode has more than {FIRST_STEPS} steps, and the first {FIRST_STEPS} do not count.")
    rows = np.sort(np.random.default_rng(seed).permutation(late)[:count])
    histories = BranchPoints(dataset).at(torch.from_numpy(rows), history)
    return Points(histories, torch.as_tensor(dataset.actions[rows]))


def with_uniform_actions(points: Points, low: np.ndarray, high: np.ndarray, *, seed: int) -> Points:
    """The same states, after the same steps, each with an action drawn uniformly from the action space (A,)."""
    uniform = np.random.default_rng(seed).uniform(low, high, points.actions.shape)
    return replace(points, actions=torch.from_numpy(uniform.astype(np.float32)))


@torch.no_grad()
def novelties(model: WorldModel, points: Points, *, batch_size: int = 1_024) -> np.ndarray | None:
    """(N,) `Prediction.novelty` of each pair, the model shown the true past; None if it has no epistemic variance."""
    found = []
    for rows in torch.arange(len(points.actions), device=points.actions.device).split(batch_size):
        state = points.histories[rows].begin(model)
        _, prediction = model.step(state, points.actions[rows])
        if prediction.novelty is None:
            return None
        found.append(prediction.novelty.cpu().numpy())
    return np.concatenate(found)


def auroc(in_distribution: np.ndarray, out_of_distribution: np.ndarray) -> float:
    """Area under the ROC curve: the chance that an out-of-distribution point scores above an in-distribution one.

    Ties count half: 0.5 is a guess, 1 is always.
    """
    inside, outside = len(in_distribution), len(out_of_distribution)
    ranks = _ranks(np.concatenate([in_distribution, out_of_distribution]))[inside:]
    above = ranks.sum() - outside * (outside + 1) / 2
    return float(above / (inside * outside))


def rank_correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Spearman's rank correlation: Pearson's of the ranks, ties sharing their mean rank; 0 where either is constant."""
    ranks = np.stack([_ranks(first), _ranks(second)])
    if ranks.size == 0 or (ranks.std(1) == 0).any():
        return 0.0
    return float(np.corrcoef(ranks)[0, 1])


def _ranks(values: np.ndarray) -> np.ndarray:
    """(N,) from 1, ties sharing their mean rank; infinities are ends, NaN is refused."""
    assert not np.isnan(values).any()
    return pd.Series(values).rank().to_numpy()


def roc_curve(
    in_distribution: np.ndarray, out_of_distribution: np.ndarray, points: int = 101
) -> tuple[np.ndarray, np.ndarray]:
    """False and true positive rates, (points,) each, as the threshold falls through the in-distribution scores."""
    false = np.linspace(0.0, 1.0, points)
    thresholds = np.quantile(in_distribution, 1.0 - false)
    true = (out_of_distribution[None] > thresholds[:, None]).mean(1)
    true[-1] = 1.0
    return false, true


@dataclass(frozen=True, eq=False)
class RolloutErrors:
    """Uncertainty and true error of M imagined steps, each held against the simulator restarted at the imagined state.

    Attributes:
        uncertainty: (M,) the model's u of the step.
        error: (M,) root mean square over live observation dimensions of (imagined - true next observation), in
            standard deviations of the training data.
        depth: (M,) metres by which the body stood in the ground where the step began (`Physics.depth`).
        given_up: share of the steps whose state the simulator could not take; they are left out.
        clipped: share of the steps, those aside, that begin where the observation clips a velocity, so that a restart
            there tells nothing of the truth; they are left out, too.
    """

    uncertainty: np.ndarray
    error: np.ndarray
    depth: np.ndarray
    given_up: float
    clipped: float


def rollout_errors(
    model: WorldModel, policy: Policy, starts: Points, physics: Physics, scale: Scale, *, steps: int
) -> RolloutErrors:
    """Rolls mean predictions out under a policy's deterministic actions, from real states after real steps.

    Args:
        model: any, on the device of `starts`.
        policy: acts on (B, S).
        starts: states to begin at; their own actions are not used.
        physics: of the robot; a rollout ends where its robot falls.
        scale: the units of the error.
        steps: of each rollout, at most.
    """
    run = imagine(model, policy, starts.histories, horizon=0, expansion=steps, terminated=physics.robot.terminated)
    begun, imagined = (x[run.valid].double().cpu().numpy() for x in (run.observations, run.next_observations))
    true, _, _ = physics.step(begun, run.actions[run.valid].cpu().numpy())
    live, std = scale.live[:-1].cpu().numpy(), scale.std[:-1].double().cpu().numpy()
    error = np.sqrt(np.square((imagined - true)[:, live] / std[live]).mean(1))
    uncertainty = run.uncertainty[run.valid].double().cpu().numpy()
    finite = np.isfinite(error) & np.isfinite(uncertainty)
    clipped = finite & physics.robot.clipped(run.observations[run.valid]).cpu().numpy()
    kept = finite & ~clipped
    depth = physics.depth(begun[kept])
    return RolloutErrors(uncertainty[kept], error[kept], depth, float(1.0 - finite.mean()), float(clipped.mean()))
