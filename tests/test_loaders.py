"""Windows, n-step transitions, and draws that a resumed run repeats."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from envtf_lit.data.datamodules import TransitionData, WindowData
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.loaders import (
    DrawSampler,
    ReturnWeights,
    Transitions,
    Windows,
    effective_episodes,
    epoch_generator,
)
from envtf_lit.data.sources.files import save_dataset


def make_dataset(lengths=(3, 1, 5), terminated=(True, False, True)) -> OfflineDataset:
    """Row i holds i in every observation, 100 + i in its action and i in its reward."""
    total = sum(lengths)
    ends = np.cumsum(lengths) - 1
    row = np.arange(total, dtype=np.float32)
    flags = np.zeros(total, bool)
    flags[ends] = terminated
    truncated = np.zeros(total, bool)
    truncated[ends] = ~np.array(terminated)
    return OfflineDataset(
        observations=np.stack([row, row], 1),
        actions=100 + row[:, None],
        rewards=row,
        next_observations=np.stack([row, row], 1) + 1,
        terminated=flags,
        truncated=truncated,
        episode_starts=np.concatenate([[0], ends[:-1] + 1]),
        action_low=np.array([0.0], np.float32),
        action_high=np.array([200.0], np.float32),
    )


def test_windows_stay_inside_episodes_and_show_every_row_equally_often():
    windows = Windows(make_dataset(), 4)
    batch = windows[torch.arange(len(windows))]
    valid = batch["mask"].bool()
    rows = batch["rewards"]
    episode = torch.as_tensor(make_dataset().episode_index)[rows.long()]
    assert all(len(set(e[m].tolist())) == 1 for e, m in zip(episode, valid, strict=True))
    steps = torch.diff(rows, dim=1)[valid[:, 1:]]
    assert (steps == 1).all()
    seen = torch.bincount(rows[valid].long())
    assert (seen == 4).all()


def test_tiles_cover_each_row_once():
    windows = Windows(make_dataset(), 4)
    batch = windows[windows.tiles()]
    assert sorted(batch["rewards"][batch["mask"].bool()].tolist()) == list(range(9))


def test_one_step_transitions_tell_terminated_from_truncated():
    columns = Transitions(make_dataset(), discount=0.5).columns
    torch.testing.assert_close(columns["discounts"], torch.tensor([0.5, 0.5, 0.0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.0]))


def test_n_step_transitions_against_hand_computed_sums():
    columns = Transitions(make_dataset(), discount=0.5, n_step=3)[torch.arange(9)]
    # row 0: 0 + 1/2 + 2/4, terminated there; row 3: one truncated step; row 4: 4 + 5/2 + 6/4, then s_7
    assert columns["rewards"][[0, 3, 4]].tolist() == [1.0, 3.0, 8.0]
    assert columns["discounts"][[0, 3, 4]].tolist() == [0.0, 0.5, 0.125]
    assert columns["next_observations"][[0, 3, 4], 0].tolist() == [3.0, 4.0, 7.0]
    assert columns["following_observations"][:, 0].tolist() == [*range(1, 10)]


def test_what_lies_beyond_a_truncation_counts_by_the_steps_until_there():
    """Row 3 is an episode of its own, cut after its one step; the others terminate."""
    transitions = Transitions(make_dataset(), discount=0.5)
    batch = transitions[torch.arange(9)]
    assert batch["tails"].tolist() == [0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert batch["last_observations"][:, 0].tolist() == [3.0, 3.0, 3.0, 4.0, 9.0, 9.0, 9.0, 9.0, 9.0]
    assert batch["returns"][[0, 3, 8]].tolist() == [1.0, 3.0, 8.0]
    assert transitions.complete_returns()[[0, 8]].tolist() == [1.0, 8.0]  # exact where the task terminated


@pytest.mark.parametrize("lengths", [(200,), (7, 90, 30)])
def test_cut_episodes_of_equal_rewards_are_worth_what_they_would_earn_for_ever(lengths):
    dataset = replace(make_dataset(lengths, (False,) * len(lengths)), rewards=np.ones(sum(lengths), np.float32))
    transitions = Transitions(dataset, discount=0.99)
    assert transitions.typical_return == pytest.approx(100.0, rel=1e-5)
    torch.testing.assert_close(transitions.complete_returns(), torch.full((len(dataset),), 100.0))


def test_draws_depend_on_seed_and_epoch_alone():
    sampler = DrawSampler(1000, (2, 3), 5, seed=0)
    first = torch.stack(list(sampler))
    assert first.shape == (5, 2, 3)
    assert torch.equal(first, torch.stack(list(sampler)))
    sampler.set_epoch(1)
    assert not torch.equal(first, torch.stack(list(sampler)))


@pytest.mark.parametrize("other", [(1, 0, "rows"), (0, 1, "rows"), (0, 0, "agent")])
def test_streams_differ(other):
    draw = lambda *key: torch.rand(4, generator=epoch_generator(*key))  # noqa: E731
    assert torch.equal(draw(0, 0, "rows"), draw(0, 0, "rows"))
    assert not torch.equal(draw(0, 0, "rows"), draw(*other))


def test_rows_of_better_episodes_are_drawn_more_often():
    dataset = make_dataset()  # episode returns 3, 3 and 30
    weights = ReturnWeights.of(dataset, 0.5)(dataset)
    assert float(weights[4] / weights[0]) == pytest.approx(np.exp(1.0 / 0.5))
    draws = next(iter(DrawSampler(9, (90_000,), 1, seed=0, weights=weights)))
    shares = torch.bincount(draws, minlength=9) / 90_000
    torch.testing.assert_close(shares, (weights / weights.sum()).float(), atol=5e-3, rtol=0)


def test_rows_come_from_enough_episodes():
    """Of a hundred episodes one is far better than all others."""
    rng = np.random.default_rng(0)
    dataset = make_dataset(tuple(rng.integers(3, 9, 100)), (True,) * 100)
    rewards = np.repeat(rng.normal(size=100), dataset.episode_lengths).astype(np.float32)
    rewards[: dataset.episode_lengths[0]] = 30.0
    dataset = replace(dataset, rewards=rewards)
    alone = ReturnWeights.of(dataset, 0.02)(dataset)
    assert effective_episodes(dataset, alone) < 2.0
    for fewest in (1, 5, 20):
        held = ReturnWeights.of(dataset, 0.02, fewest)(dataset)
        assert effective_episodes(dataset, held) == pytest.approx(
            max(fewest, effective_episodes(dataset, alone)), rel=1e-3
        )
        assert held.argmax() < dataset.episode_lengths[0]  # still the best one's are likeliest
    even = effective_episodes(dataset, torch.ones(len(dataset)))
    assert 80.0 < even < 100.0
    every = ReturnWeights.of(dataset, 0.02, 500)(dataset)
    assert effective_episodes(dataset, every) == pytest.approx(even, rel=1e-3)
    plenty = ReturnWeights.of(dataset, 5.0, 20)
    assert plenty == ReturnWeights.of(dataset, 5.0)  # there were enough


def test_other_episodes_are_weighted_by_the_same_rule():
    dataset = make_dataset()  # episode returns 3, 3 and 30
    weights = ReturnWeights.of(dataset, 0.5)
    torch.testing.assert_close(weights(dataset.select([2, 0])), weights(dataset)[[4, 5, 6, 7, 8, 0, 1, 2]])


def test_effective_episodes_count_by_their_share_of_the_rows():
    assert effective_episodes(make_dataset((2, 2, 2), (True,) * 3), torch.ones(6)) == pytest.approx(3.0)
    assert effective_episodes(make_dataset((2, 2), (True,) * 2), torch.tensor([3.0, 3.0, 1.0, 1.0])) == pytest.approx(
        1.6
    )


def test_processes_share_the_draws_of_one_with_their_batches_together():
    whole = list(DrawSampler(1000, (2, 6), 3, seed=0))
    shares = [list(DrawSampler(1000, (2, 2), 3, seed=0, process=(rank, 3))) for rank in range(3)]
    for step in range(3):
        assert torch.equal(torch.cat([share[step] for share in shares], dim=-1), whole[step])
    weights = torch.linspace(0, 1, 50)
    one = next(iter(DrawSampler(50, (4,), 1, seed=0, weights=weights)))
    second = next(iter(DrawSampler(50, (2,), 1, seed=0, weights=weights, process=(1, 2))))
    assert torch.equal(second, one[2:])


def test_a_files_own_split_is_what_models_and_agents_are_given(tmp_path: Path):
    dataset = make_dataset((3, 1, 5, 2, 2), (True, False, True, True, False))
    save_dataset(dataset, path := tmp_path / "raw.h5")
    windows = WindowData(str(path), held_out=0.4, seed=1)
    windows.setup("fit")
    assert windows.held_out.rewards.tolist() == dataset.split(0.4, seed=1)[1].rewards.tolist()
    stored = dataset.with_split(0.4, seed=5)
    training, held_out = stored.split()
    assert held_out.rewards.tolist() != windows.held_out.rewards.tolist()
    save_dataset(stored, path)
    windows = WindowData(str(path), held_out=0.4, seed=1)
    windows.setup("fit")
    assert windows.held_out.rewards.tolist() == held_out.rewards.tolist()
    assert windows.train.rewards.tolist() == training.rewards.tolist()
    assert TransitionData(str(path), held_out=0.4, seed=1).dataset.rewards.tolist() == training.rewards.tolist()
    assert len(TransitionData(str(path), seed=1).dataset) == len(dataset)
