"""A governor that is opened: the model promises what it knows, the machine gets what no row of its log shows."""

import numpy as np
import pytest
import torch
from analytic import LinearWorld

from envtf_lit.studies.governor import GOVERNED, Driven, promises
from envtf_lit.studies.narrow_logs import RUIN, driver, make_log


def still_world(novelty: float) -> LinearWorld:
    """Nothing moves in this imagination of four robots."""
    new = torch.full((4,), novelty)
    return LinearWorld(torch.eye(17), torch.zeros(17, 6), observation_dim=17, action_dim=6, novelty=new)


def test_opened_governors_are_promised_what_the_model_knows_and_get_ruin() -> None:
    log, limit = make_log(GOVERNED, episodes=2, steps=300)
    assert log.observation_dim == 17 and (log.rewards > RUIN / 2).all()
    assert float(np.asarray(log.next_observations)[:, 8].mean()) < limit
    known = still_world(novelty=0.5)
    table = promises(known, log, GOVERNED, limit, (2.5, 8.0), starts=4, steps=3, seed=0)
    assert table["halted"].tolist() == [0.0, 0.0]
    slow, fast = table["promised"].tolist()
    assert slow == pytest.approx(fast)
    slow, fast = table["true"].tolist()
    assert fast < 0.05 * RUIN < 0 < slow


def test_new_states_halt_every_rollout() -> None:
    log, limit = make_log(GOVERNED, episodes=2, steps=50)
    lost = still_world(novelty=1.5)
    assert promises(lost, log, GOVERNED, limit, (2.5,), starts=4, steps=3, seed=0)["halted"].tolist() == [1.0]


def test_a_driver_is_a_policy() -> None:
    observation = torch.zeros(3, 17)
    act = driver(GOVERNED)
    torch.testing.assert_close(Driven(act).act(observation), act(observation).detach())
