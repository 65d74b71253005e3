"""Stock learners in the imagined environment: the wrappers of stable-baselines3 and TorchRL, and SAC."""

from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv

from envtf_lit.imagination.env import ImaginedEnv
from envtf_lit.policy import PredictingPolicy
from envtf_lit.studies.planning import PlanningOptions, learned_pendulum, play
from tests.test_imagined_env import imagined


def test_stable_baselines3_accepts_it():
    check_env(imagined(max_steps=5), skip_render_check=True)
    vector = DummyVecEnv([lambda: imagined(max_steps=2)] * 2)
    vector.seed(0)
    assert vector.reset().shape == (2, 3)  # pyright: ignore[reportAttributeAccessIssue]
    ends = [vector.step(np.zeros((2, 1), np.float32)) for _ in range(2)]
    assert ends[1][2].all() and all("terminal_observation" in info for info in ends[1][3])
    assert all(info["TimeLimit.truncated"] for info in ends[1][3])


@pytest.mark.filterwarnings("ignore")  # TorchRL's own, at its import
def test_torchrl_accepts_it():
    from torchrl.envs import GymWrapper
    from torchrl.envs.utils import check_env_specs

    env = GymWrapper(imagined(max_steps=5))
    check_env_specs(env)
    rollout = env.rollout(12)
    assert rollout["next", "truncated"].sum() == 1 and len(rollout) == 5


@pytest.mark.slow
def test_a_stock_sac_that_never_saw_the_pendulum_swings_it_up(tmp_path: Path):
    """Trained in a world model of random steps alone; scored in the simulator, where it began at about -1,300."""
    options = PlanningOptions(episodes=10)
    folder = learned_pendulum(tmp_path, options, progress=False)
    env = ImaginedEnv(folder, tmp_path / "random.h5", max_steps=100, starts="rows", novelty_limit=None, history=1)
    agent = SAC("MlpPolicy", env, learning_starts=200, learning_rate=1e-3, seed=0, policy_kwargs={"net_arch": [64, 64]})
    before = play(PredictingPolicy(agent), options).mean()
    agent.learn(4_000)
    assert play(PredictingPolicy(agent), options).mean() > max(-400.0, before + 500.0)
