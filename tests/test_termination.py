"""Terminations learned from a log: Hopper's rule found again, and logs that teach nothing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.errors import UserError
from envtf_lit.robots.termination import hopper_terminated
from envtf_lit.world_models import termination_head
from envtf_lit.world_models.termination_head import (
    TerminationHead,
    learn_termination,
    load_termination,
    save_termination,
)
from tests.analytic import linear_data


@pytest.fixture(scope="module")
def log() -> OfflineDataset:
    """States about Hopper's, drawn at random, each terminated or not by Hopper's rule."""
    states = np.random.default_rng(0).normal(size=(8_000, 11)) * [0.2, 0.1, *(9 * [1.0])] + [1.2, *(10 * [0.0])]
    states = states.astype(np.float32)
    fell = hopper_terminated(torch.from_numpy(states)).numpy()
    assert 0.03 < fell.mean() < 0.1
    flat = linear_data((2, 2), seed=0)
    return replace(
        flat,
        **dict(observations=states, next_observations=states, actions=np.zeros((8_000, 1), np.float32)),
        **dict(rewards=np.zeros(8_000, np.float32), terminated=fell, truncated=np.zeros(8_000, bool)),
        episode_starts=np.arange(0, 8_000, 100),
    )


@pytest.fixture(scope="module")
def head(log: OfflineDataset) -> TerminationHead:
    found = learn_termination(log.split(0.3, seed=0)[0], seed=0)
    assert found is not None
    return found


def test_hoppers_rule_is_found_again(log: OfflineDataset, head: TerminationHead) -> None:
    training, held_out = log.split(0.3, seed=0)
    scores = head.scores(held_out)
    assert scores["termination_recall"] > 0.75
    assert scores["termination_false_alarms"] < 0.01
    said = head.terminated(torch.as_tensor(held_out.next_observations)).numpy()
    assert scores["termination_recall"] == pytest.approx(said[held_out.terminated].mean())
    assert scores["termination_false_alarms"] == pytest.approx(said[~held_out.terminated].mean())
    said = head.terminated(torch.as_tensor(training.next_observations))  # as often as it happened
    assert int(said.sum()) == training.terminated.sum()
    deep = torch.tensor([[0.5, *(10 * [0.0])], [1.2, 0.3, *(9 * [0.0])], [1.2, *(10 * [0.0])]])
    assert head.terminated(deep).tolist() == [True, True, False]


def test_equal_seeds_learn_equal_heads_whatever_was_drawn_before(
    log: OfflineDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(termination_head, "UPDATES", 20)
    short = log.select(range(20))
    torch.manual_seed(1)
    state = torch.random.get_rng_state()
    first = learn_termination(short, seed=3)
    assert torch.equal(torch.random.get_rng_state(), state)
    torch.rand(7)
    second, other = learn_termination(short, seed=3), learn_termination(short, seed=4)
    assert first is not None and second is not None and other is not None
    assert all(
        torch.equal(a, b) for a, b in zip(first.state_dict().values(), second.state_dict().values(), strict=True)
    )
    assert not torch.equal(first.state_dict()["layers.0.weight"], other.state_dict()["layers.0.weight"])


def test_where_the_state_says_nothing_nothing_is_said_but_of_what_is_no_state(
    log: OfflineDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(termination_head, "UPDATES", 50)
    blind = replace(log, next_observations=np.zeros((8_000, 11), np.float32))
    head = learn_termination(blind, seed=0)
    assert head is not None
    assert not head.terminated(torch.zeros(5, 11)).any()
    assert bool(head.terminated(torch.full((11,), torch.nan)))


def test_a_log_without_terminations_teaches_nothing() -> None:
    data = linear_data((10, 10))
    assert learn_termination(data, seed=0) is None
    assert learn_termination(replace(data, terminated=np.ones(20, bool)), seed=0) is None


def test_scores_leave_out_what_the_log_does_not_have(head: TerminationHead, log: OfflineDataset) -> None:
    standing = replace(log, terminated=np.zeros(len(log), bool))
    assert set(head.scores(standing)) == {"termination_false_alarms"}


def test_a_saved_head_says_the_same(head: TerminationHead, log: OfflineDataset, tmp_path: Path) -> None:
    save_termination(tmp_path / "termination", head)
    again = load_termination(tmp_path / "termination")
    rows = torch.as_tensor(log.next_observations[:100])
    assert torch.equal(again(rows), head(rows).detach())
    with pytest.raises(UserError, match="is not a model folder"):
        load_termination(tmp_path / "nowhere")
