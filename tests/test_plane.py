"""The point on a plane: its rule, its log, and what becomes of critics that nobody contradicts."""

from pathlib import Path

import lightning
import numpy as np
import pytest
import torch
from torch import Tensor

from envtf_lit.data.sources.files import save_dataset
from envtf_lit.studies.plane import BLOCK, GOAL, START, STEPS, learn, move, plane_log, walk

SIZES = dict(updates_per_epoch=20, batch_size=32, hidden=(16, 16), warm_start=0.0, n_step=1, discount=0.97)


class Straight:
    """Towards the goal, whatever stands between."""

    def act(self, observation: Tensor, deterministic: bool = True, generator: torch.Generator | None = None) -> Tensor:
        return (torch.tensor(GOAL) - observation).clamp(-1, 1)


def test_the_block_stops_and_nothing_is_earned() -> None:
    following, rewards = move(np.array([[0.0, 0.8], [-0.5, 0.0], [0.95, 0.0]]), np.array([[1.0, 0.0]] * 3))
    np.testing.assert_allclose(following, [[0.15, 0.8], [-0.5, 0.0], [1.0, 0.0]])
    np.testing.assert_allclose(rewards, -np.hypot(following[:, 0] - 0.8, following[:, 1] - 0.8))


def test_the_log_never_meets_the_block_and_arrives() -> None:
    log = plane_log(20, seed=0)
    assert len(log) == 20 * STEPS and log.truncated.sum() == 20 and not log.terminated.any()
    assert np.abs(log.next_observations).max(1).min() > BLOCK
    last = log.next_observations[log.truncated]
    assert np.linalg.norm(last - np.array(GOAL), axis=1).max() < 0.3
    steady = plane_log(20, seed=0, noise=0.0)
    assert np.asarray(steady.actions).std() < np.asarray(log.actions).std()


def test_the_straight_way_ends_at_the_block() -> None:
    paths, returns = walk(Straight(), 4, seed=0)
    assert paths.shape == (4, STEPS + 1, 2) and np.abs(paths[:, 0] - np.array(START)).max() < 0.4
    assert np.linalg.norm(paths[:, -1] - np.array(GOAL), axis=1).min() > 0.5
    assert returns.max() < plane_log(20, seed=0).episode_returns.mean()


def test_what_is_learned_comes_with_its_critics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save_dataset(plane_log(10, seed=0), Path("plane.h5"))
    lightning.seed_everything(0, verbose=False)
    found = learn("cql", Path("plane.h5"), seed=0, updates=40, **SIZES)
    assert found.stopped is None and len(found.curves) == 2 and "train/q_data" in found.curves
    q = found.q(np.array([-0.8, 0.0]), 3)
    action = torch.tensor([[-1.0, 1.0]])
    own = found.agent.critics(torch.tensor([[-0.8, 0.0]]), action).min(0).values * found.agent.return_scale
    assert q.shape == (3, 3) and q[0, 2] == pytest.approx(float(own.detach()), rel=1e-4)
    assert not list(tmp_path.glob(".envtf/runs/*"))  # nothing is left to resume


@pytest.mark.slow
def test_a_training_that_diverges_is_kept_with_the_sentence_that_stopped_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A log that always did the same: nothing contradicts what critics believe of the rest."""
    monkeypatch.chdir(tmp_path)
    save_dataset(plane_log(60, seed=0, noise=0.02), Path("plane.h5"))
    lightning.seed_everything(0, verbose=False)
    rates = dict(critic_learning_rate=0.001, actor_learning_rate=0.001, target_rate=0.05, actor_average=0.01)
    sizes = SIZES | dict(updates_per_epoch=100, batch_size=64, hidden=(64, 64), layer_norm=False, discount=0.99)
    found = learn("sac", Path("plane.h5"), seed=0, updates=3_000, return_temperature=None, **sizes, **rates)
    assert found.stopped is not None and "feed on themselves" in found.stopped
    assert len(found.curves) < 30 and found.curves["train/q_data"].iloc[-1] > 0 > found.curves["train/q_data"].iloc[0]
    assert not list(tmp_path.glob(".envtf/runs/*"))
