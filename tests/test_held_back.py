"""The machine that was held back: its log is slow, and whoever goes faster pays for it without having been told."""

import numpy as np
import pytest
import torch
from analytic import LinearWorld

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.studies.held_back import PUNISHMENT, RECORDED_SPEED, SPEED, Governed, held_back_log, promises


@pytest.fixture(scope="module")
def log() -> OfflineDataset:
    return held_back_log(2, seed=0)


def test_the_log_is_slow_and_its_episodes_nearly_equal(log: OfflineDataset) -> None:
    assert log.episode_lengths.tolist() == [1000, 1000] and log.truncated.sum() == 2
    late = np.arange(len(log)) % 1000 >= 200
    speed = log.observations[late, SPEED]
    assert 0.8 * RECORDED_SPEED < speed.mean() < 1.4 * RECORDED_SPEED  # it fades actions out, and does not brake
    assert abs(np.diff(log.episode_returns)) < 0.1 * log.episode_returns.mean()
    assert (log.rewards > PUNISHMENT / 2).all()


def test_the_governor_fades_the_actions_out_where_the_robot_is_too_fast() -> None:
    observation = torch.zeros(2, 17)
    observation[1, SPEED] = 2 * RECORDED_SPEED
    standing, fast = Governed(RECORDED_SPEED).act(observation).abs()
    free = Governed(100.0).act(observation[1:]).abs()[0]
    assert (fast <= free).all() and fast.mean() < 0.5 * free.mean()
    assert standing.max() <= 1.0


def test_faster_governors_are_promised_what_the_model_knows_and_get_the_punishment(log: OfflineDataset) -> None:
    world = LinearWorld(torch.eye(17), torch.zeros(17, 6), observation_dim=17, action_dim=6)
    known = LinearWorld(world.matrix, world.gain, observation_dim=17, action_dim=6, novelty=torch.full((4,), 0.5))
    table = promises(known, log, (RECORDED_SPEED, 6.0), starts=4, steps=3, seed=0)
    assert table["halted"].tolist() == [0.0, 0.0]
    assert table["promised"][0] == pytest.approx(table["promised"][1])  # nothing moves in this imagination
    assert table["true"][1] < 0.1 * PUNISHMENT < 0 < table["true"][0]
