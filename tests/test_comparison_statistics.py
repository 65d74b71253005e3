"""The comparison's statistics against formulas written another way, and against rliable where it is installed."""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy import stats

from envtf_lit.comparison.statistics import (
    Estimate,
    interquartile_mean,
    mean_over_seeds,
    paired_difference,
    probability_of_improvement,
)


def some_samples(tasks: int = 20, seeds: int = 3, *, shift: float = 0.0, seed: int = 0) -> list[np.ndarray]:
    generator = np.random.default_rng(seed)
    return [generator.normal(5.0 * task + shift, 4.0, seeds) for task in range(tasks)]


def trimmed(values: np.ndarray) -> float:
    """The mean of what is left when a quarter is taken from either end."""
    ordered, cut = np.sort(values), len(values) // 4
    return float(ordered[cut : len(values) - cut].mean())


def resampled_by_hand(samples: Sequence[np.ndarray], rounds: int = 2_000) -> tuple[float, float]:
    """Percentiles of the IQM of seeds drawn anew within each task, one after the other."""
    generator = np.random.default_rng(99)
    drawn = [trimmed(np.concatenate([generator.choice(x, len(x)) for x in samples])) for _ in range(rounds)]
    low, high = np.percentile(drawn, [2.5, 97.5])
    return float(low), float(high)


def test_the_iqm_is_the_mean_of_the_middle_half() -> None:
    assert interquartile_mean([np.array([0.0, 10.0, 20.0, 1_000.0])]).value == 15.0
    samples = some_samples()
    found = interquartile_mean(samples)
    assert found.value == pytest.approx(trimmed(np.concatenate(samples)))
    assert found.count == 60


def test_its_interval_is_that_of_a_bootstrap_within_tasks() -> None:
    samples = some_samples()
    found, (low, high) = interquartile_mean(samples), resampled_by_hand(samples)
    width = high - low
    assert found.low is not None and found.high is not None
    assert (found.low, found.high) == (pytest.approx(low, abs=0.15 * width), pytest.approx(high, abs=0.15 * width))
    assert interquartile_mean(samples) == found  # the same every time
    plain = np.percentile(np.random.default_rng(0).choice(np.concatenate(samples), (2_000, 60)).mean(-1), [2.5, 97.5])
    assert width < 0.3 * float(plain[1] - plain[0])  # tasks that differ do not widen it


def test_one_seed_a_task_gives_no_interval_and_a_mixture_gives_one() -> None:
    ones = [sample[:1] for sample in some_samples()]
    assert interquartile_mean(ones) == Estimate(pytest.approx(trimmed(np.concatenate(ones))), None, None, 20)  # pyright: ignore[reportArgumentType]
    mixed = interquartile_mean([np.array([1.0]), np.array([2.0, 4.0]), np.array([3.0])])
    assert mixed.low is not None and mixed.low < mixed.value < (mixed.high or 0.0)


def test_the_chance_to_be_higher_is_the_mann_whitney_statistic() -> None:
    first, second = some_samples(shift=2.0, seed=1), some_samples(seed=2)
    by_scipy = [
        stats.mannwhitneyu(x, y, alternative="greater").statistic / (len(x) * len(y))
        for x, y in zip(first, second, strict=True)
    ]
    found = probability_of_improvement(first, second)
    assert found.value == pytest.approx(np.mean(by_scipy))
    assert found.low is not None and found.low < found.value < (found.high or 0.0)
    assert probability_of_improvement(first, first).value == 0.5
    higher = probability_of_improvement([sample + 100.0 for sample in second], second)
    assert (higher.value, higher.low, higher.high) == (1.0, 1.0, 1.0)


def test_a_paired_difference_is_taken_run_by_run() -> None:
    first = some_samples()
    constant = paired_difference([sample + 3.0 for sample in first], first)
    for found in (constant.over_seeds, constant.over_tasks):
        assert (found.value, found.low, found.high) == (pytest.approx(3.0),) * 3
    assert (constant.over_seeds.count, constant.over_tasks.count) == (60, 20)
    second = some_samples(seed=7)
    means = [float(x.mean() - y.mean()) for x, y in zip(first, second, strict=True)]
    by_scipy = stats.ttest_1samp(means, 0.0).confidence_interval()
    over_tasks = paired_difference(first, second).over_tasks
    assert (over_tasks.low, over_tasks.high) == (pytest.approx(by_scipy.low), pytest.approx(by_scipy.high))


def test_a_pair_on_one_task_says_nothing_of_other_tasks() -> None:
    found = paired_difference([np.array([1.0, 2.0])], [np.array([0.0, 0.0])])
    assert found.over_tasks == Estimate(1.5, None, None, 1)
    assert found.over_seeds.low == 1.0


def test_the_interval_of_a_tasks_seeds_is_students() -> None:
    scores = np.array([50.0, 56.0, 62.0])
    found, (low, high) = mean_over_seeds(scores), stats.t.interval(0.95, 2, 56.0, stats.sem(scores))
    assert (found.value, found.low, found.high) == (56.0, pytest.approx(low), pytest.approx(high))
    assert mean_over_seeds(scores[:1]) == Estimate(50.0, None, None, 1)


def test_rliable_finds_the_same() -> None:
    metrics = pytest.importorskip("rliable.metrics", reason="an oracle that few have: pip install --no-deps rliable")
    first, second = some_samples(shift=2.0, seed=1), some_samples(seed=2)
    x, y = np.stack(first, axis=1), np.stack(second, axis=1)  # (seeds, tasks)
    assert interquartile_mean(first).value == pytest.approx(metrics.aggregate_iqm(x))
    assert probability_of_improvement(first, second).value == pytest.approx(metrics.probability_of_improvement(x, y))


# What rliable 1.2.0 finds with arch 7.2, which needs a pandas below 3: `get_interval_estimates(…, reps=2000)`
BY_RLIABLE = {"iqm": (47.898, 50.010), "improvement": (0.539, 0.728)}


def test_intervals_are_those_that_rliable_found() -> None:
    first, second = some_samples(shift=2.0, seed=1), some_samples(seed=2)
    iqm, improvement = interquartile_mean(first), probability_of_improvement(first, second)
    assert (iqm.low, iqm.high) == pytest.approx(BY_RLIABLE["iqm"], abs=0.1)
    assert (improvement.low, improvement.high) == pytest.approx(BY_RLIABLE["improvement"], abs=0.01)
