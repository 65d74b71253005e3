"""OfflineDataset against hand-computed cases."""

from dataclasses import replace

import numpy as np
import pytest
from analytic import linear_data

from envtf_lit.data.dataset import COLUMNS, OfflineDataset, starts_from_ends
from envtf_lit.errors import UserError


def make(lengths: list[int]) -> OfflineDataset:
    """Row i has observation [i, i], successor i + 1, action i / 100 and reward i; episodes end terminated, truncated,
    terminated and so on."""
    rows = sum(lengths)
    index = np.arange(rows, dtype=np.float32)
    starts = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64)
    last = np.cumsum(lengths) - 1
    terminated, truncated = np.zeros(rows, bool), np.zeros(rows, bool)
    terminated[last[::2]], truncated[last[1::2]] = True, True
    observations = np.stack([index, index], axis=1)
    limit = np.ones(1, np.float32)
    return OfflineDataset(
        observations, index[:, None] / 100, index, observations + 1, terminated, truncated, starts, -limit, limit
    )


def test_episodes():
    dataset = make([2, 3, 4])
    assert dataset.episode_lengths.tolist() == [2, 3, 4]
    assert dataset.episode_ends.tolist() == [2, 5, 9]
    assert dataset.episode_returns.tolist() == [0 + 1, 2 + 3 + 4, 5 + 6 + 7 + 8]
    assert dataset.episode_index.tolist() == [0, 0, 1, 1, 1, 2, 2, 2, 2]


def test_starts_from_ends():
    assert starts_from_ends(np.array([False, True, False, False, True])).tolist() == [0, 2]
    assert starts_from_ends(np.array([False, True, False, False, False])).tolist() == [0, 2]


def test_select_keeps_the_order_asked_for():
    chosen = make([2, 3, 4]).select([2, 0])
    assert chosen.rewards.tolist() == [5, 6, 7, 8, 0, 1]
    assert chosen.episode_starts.tolist() == [0, 4]
    assert chosen.terminated.tolist() == [False] * 3 + [True] + [False, True]
    assert chosen.next_observations[:, 0].tolist() == [6, 7, 8, 9, 1, 2]


def test_select_nothing_is_an_error():
    with pytest.raises(UserError, match="at least one episode"):
        make([2, 3]).select([])


@pytest.mark.parametrize(("share", "held"), [(0.1, 1), (0.4, 2), (0.99, 4)])
def test_split_partitions_the_episodes(share: float, held: int):
    dataset = make([2, 3, 4, 5, 6])
    train, test = dataset.split(share, seed=0)
    assert len(test.episode_starts) == held
    assert sorted([*train.rewards, *test.rewards]) == dataset.rewards.tolist()
    again = dataset.split(share, seed=0)[1]
    assert all(np.array_equal(getattr(test, name), getattr(again, name)) for name in COLUMNS)


def test_a_split_is_kept_and_spent():
    dataset = make([2, 3, 4, 5, 6]).with_split(0.4, seed=3)
    assert dataset.held_out is not None and dataset.held_out.sum() == 2
    for one, two in zip(dataset.split(), make([2, 3, 4, 5, 6]).split(0.4, seed=3), strict=True):
        assert np.array_equal(one.rewards, two.rewards) and one.held_out is None
    assert np.array_equal(dataset.split(0.9, seed=1)[1].rewards, dataset.split()[1].rewards)
    order = np.random.default_rng(3).permutation(5)
    assert np.flatnonzero(dataset.held_out).tolist() == sorted(order[:2])


def test_a_dataset_without_a_split_says_so():
    with pytest.raises(UserError, match="give it a split"):
        make([2, 3]).split()


def test_split_needs_two_episodes():
    with pytest.raises(UserError, match="one episode"):
        make([4]).split(0.5, seed=0)


def test_returns_to_go():
    dataset = make([2, 3])  # rewards 0 1 | 2 3 4
    expected = [0 + 0.5 * 1, 1, 2 + 0.5 * (3 + 0.5 * 4), 3 + 0.5 * 4, 4]
    assert dataset.returns_to_go(0.5).tolist() == expected
    assert dataset.returns_to_go(0.0).tolist() == dataset.rewards.tolist()


def test_held_out_episodes_are_for_validation_or_for_testing() -> None:
    data = linear_data((4, 5, 6, 7, 8))
    validation, test = data.validation_and_test()
    assert validation.episode_lengths.tolist() == [5, 7] and test.episode_lengths.tolist() == [4, 6, 8]
    for lone in data.select([3]).validation_and_test():
        assert lone.episode_lengths.tolist() == [7]


def test_a_dataset_is_printed_in_a_line() -> None:
    dataset = make([1_000, 200])
    assert repr(dataset) == "<OfflineDataset 1,200 steps in 2 episodes, observations of 2, actions of 1>"
    assert repr(replace(dataset, task="hopper-medium")).startswith("<OfflineDataset hopper-medium: 1,200 steps")
