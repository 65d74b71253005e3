"""Soft actor-critic solves Gymnasium's Pendulum online, and agents learn from its log alone what it learned there."""

from pathlib import Path

import numpy as np
import pytest

from tests.pendulum import OFFLINE, learn_offline, learn_online, mean_return, random_return, save_log

pytestmark = pytest.mark.slow
Learned = tuple[np.ndarray, float, Path]


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Learned:
    """Curves, the expert's mean return, and the log of all that it lived through."""
    curves, data, agent = learn_online(seed=0)
    log = tmp_path_factory.mktemp("pendulum") / "log.h5"
    save_log(data, log)
    return curves, mean_return(agent.average_actor), log


def test_soft_actor_critic_solves_the_pendulum_within_eight_thousand_steps(
    learned: Learned,
) -> None:
    """-200 is what swings it up at once; random actions return about -1,200."""
    curves, expert, _ = learned
    steps, returns = curves.T
    assert returns[0] < -900 and returns[steps <= 8_000][-1] >= -200 and expert >= -200


@pytest.mark.parametrize("algorithm", [name for name in OFFLINE if name != "bc"])
def test_an_agent_reaches_nine_tenths_of_the_expert_from_its_log_alone(
    algorithm: str, learned: Learned, tmp_path: Path
) -> None:
    """Of the way from random actions' return to the expert's; cloning what the learner did all along does not."""
    _, expert, log = learned
    random = random_return()
    assert (learn_offline(algorithm, log, tmp_path, seed=0) - random) / (expert - random) >= 0.9
