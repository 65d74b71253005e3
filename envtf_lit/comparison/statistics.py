"""What may be said of algorithms from a few seeds on many tasks (Agarwal et al., NeurIPS 2021), with intervals.

Samples are given by task: each holds the scores of its seeds. Intervals are of 95 %: percentiles of a bootstrap that
draws seeds anew within each task, with a fixed seed of its own. They say how much other training seeds would change, on
these tasks; where each task has one seed alone there is none.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from envtf_lit.evaluation.comparison import compare

LEVEL, RESAMPLES, SEED = 0.95, 2_000, 0

Samples = Sequence[np.ndarray]  # of each task, (seeds,)
Statistic = Callable[[list[np.ndarray]], np.ndarray]  # of each task's (..., seeds), to (...)


@dataclass(frozen=True)
class Estimate:
    """A number and its interval, None where there is none.

    Attributes:
        value: of what was measured.
        low, high: ends of the interval.
        count: of the scores, or of the pairs, that it is taken from.
    """

    value: float
    low: float | None
    high: float | None
    count: int


def stratified(samples: Samples, statistic: Statistic, count: int | None = None) -> Estimate:
    """A statistic of all tasks and its interval by stratified bootstrap.

    Args:
        samples: of the tasks; those of one seed stay as they are.
        statistic: takes arrays of the samples' shapes with any dimensions before the last.
        count: of what it is taken from; None for all scores.
    """
    arrays = [np.asarray(sample, dtype=np.float64) for sample in samples]
    total = sum(map(len, arrays)) if count is None else count
    value, several = float(statistic(arrays)), [index for index, array in enumerate(arrays) if len(array) > 1]
    if not several:
        return Estimate(value, None, None, total)

    def resampled(*drawn: np.ndarray, axis: int) -> np.ndarray:
        again = dict(zip(several, drawn, strict=True))
        shape = drawn[0].shape[:-1]
        return statistic([again.get(i, np.broadcast_to(array, (*shape, len(array)))) for i, array in enumerate(arrays)])

    settings: dict[str, Any] = dict(method="percentile", confidence_level=LEVEL, n_resamples=RESAMPLES, axis=-1)
    drawn = tuple(arrays[index] for index in several)
    found = stats.bootstrap(drawn, resampled, vectorized=True, rng=np.random.default_rng(SEED), **settings)
    low, high = found.confidence_interval
    return Estimate(value, float(low), float(high), total)


def interquartile_mean(samples: Samples) -> Estimate:
    """The mean of the middle half of all scores (IQM)."""
    return stratified(samples, lambda by_task: stats.trim_mean(np.concatenate(by_task, axis=-1), 0.25, axis=-1))


def mean_over_seeds(scores: np.ndarray) -> Estimate:
    """The mean of one task's seeds (n,), with Student's interval; it takes the seeds for normal, and 3 make it wide."""
    count, value = len(scores), float(np.mean(scores))
    if count < 2:
        return Estimate(value, None, None, count)
    width = _student(count) * float(np.std(scores, ddof=1)) / count**0.5
    return Estimate(value, value - width, value + width, count)


def probability_of_improvement(first: Samples, second: Samples) -> Estimate:
    """The chance that a run of the first scores higher than one of the second on a task, the mean over tasks.

    Ties count half; it is the Mann-Whitney statistic over the number of pairs.
    """
    tasks = len(first)

    def chance(by_task: list[np.ndarray]) -> np.ndarray:
        pairs = zip(by_task[:tasks], by_task[tasks:], strict=True)
        return np.mean([_chance(x[..., :, None], y[..., None, :]) for x, y in pairs], axis=0)

    return stratified([*first, *second], chance, tasks)


def _chance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return ((first > second) + 0.5 * (first == second)).mean((-2, -1))


@dataclass(frozen=True)
class Difference:
    """A paired difference between two algorithms, by two intervals.

    Attributes:
        over_seeds: mean over tasks of the mean over seeds; the interval says how far other seeds would move it.
        over_tasks: the same; the interval says how far other tasks would, too (Student's, over the tasks' means).
    """

    over_seeds: Estimate
    over_tasks: Estimate


def paired_difference(first: Samples, second: Samples) -> Difference:
    """How much higher the first algorithm scores than the second with the same tasks and seeds.

    Args:
        first: scores, the seeds of each task in an order.
        second: of the other, in the same order.
    """
    differences = [np.asarray(x) - np.asarray(y) for x, y in zip(first, second, strict=True)]
    seeds = stratified(differences, lambda by_task: np.mean([found.mean(-1) for found in by_task], axis=0))
    found = compare(*(np.array([np.mean(scores) for scores in samples]) for samples in (first, second)))
    if found.starts < 2:
        return Difference(seeds, Estimate(found.gain, None, None, found.starts))
    width = _student(found.starts) * found.standard_error
    return Difference(seeds, Estimate(found.gain, found.gain - width, found.gain + width, found.starts))


def _student(count: int) -> float:
    return float(stats.t.ppf(0.5 + LEVEL / 2, count - 1))
