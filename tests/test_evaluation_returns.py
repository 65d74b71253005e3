"""Scores of a policy: one episode per seed, whatever runs beside it."""

import gymnasium
import numpy as np
import pytest
import torch

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.errors import UserError
from envtf_lit.robots.returns import ROWS, evaluate_policy
from envtf_lit.robots.tasks import ROBOTS

HOPPER = ROBOTS["hopper"]


@pytest.fixture(scope="module")
def actor() -> TanhGaussianActor:
    torch.manual_seed(3)
    return TanhGaussianActor(11, 3, hidden=(32, 32)).eval()


def play_alone(actor: TanhGaussianActor, seed: int) -> tuple[float, int]:
    env = gymnasium.make("Hopper-v5")
    observation, _ = env.reset(seed=seed)
    total, length, over = 0.0, 0, False
    batch = torch.zeros(ROWS, 11)
    while not over:
        batch[(seed - 1000) % ROWS] = torch.from_numpy(observation).float()
        action = actor.act(batch)[(seed - 1000) % ROWS].numpy()
        observation, reward, terminated, truncated, _ = env.step(action)
        total, length, over = total + float(reward), length + 1, terminated or truncated
    return total, length


def test_returns_equal_episodes_played_alone(actor):
    result = evaluate_policy(actor, HOPPER, episodes=4, seed=0, progress=False)
    alone = [play_alone(actor, 1000 + i) for i in range(4)]
    np.testing.assert_array_equal(result.lengths, [length for _, length in alone])
    np.testing.assert_allclose(result.returns, [total for total, _ in alone], rtol=1e-12)
    np.testing.assert_allclose(result.scores, [HOPPER.normalised_score(total) for total, _ in alone])


def test_an_episode_does_not_depend_on_the_number_beside_it(actor):
    few = evaluate_policy(actor, HOPPER, episodes=3, seed=5, progress=False)
    many = evaluate_policy(actor, HOPPER, episodes=ROWS + 2, seed=5, progress=False)
    np.testing.assert_array_equal(few.returns, many.returns[:3])
    assert len(many.returns) == ROWS + 2
    assert len(np.unique(many.returns)) == ROWS + 2


def test_median_episode_is_the_one_of_median_return(actor):
    result = evaluate_policy(actor, HOPPER, episodes=5, seed=0, progress=False)
    median = result.median
    index = median.seed - 1000
    assert median.rewards.sum() == np.median(result.returns) == result.returns[index]
    assert len(median.actions) == result.lengths[index] == len(median.observations) - 1
    np.testing.assert_array_equal(median.observations[:, :5], median.positions[:, 1:].astype(np.float32))


def test_time_limit_ends_an_episode(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo notes a deprecated attribute of this robot in MUJOCO_LOG.TXT, wherever it is

    class Still:
        def act(self, observation, deterministic=True, generator=None):
            return torch.zeros(len(observation), 6)

    result = evaluate_policy(Still(), ROBOTS["halfcheetah"], episodes=2, seed=0, progress=False)
    np.testing.assert_array_equal(result.lengths, [1000, 1000])


def test_non_finite_actions_and_no_episodes_are_refused(actor):
    class Broken:
        def act(self, observation, deterministic=True, generator=None):
            return torch.full((len(observation), 3), float("nan"))

    with pytest.raises(UserError, match="not finite"):
        evaluate_policy(Broken(), HOPPER, episodes=1, seed=0, progress=False)
    with pytest.raises(UserError, match="at least one episode"):
        evaluate_policy(actor, HOPPER, episodes=0, seed=0, progress=False)
