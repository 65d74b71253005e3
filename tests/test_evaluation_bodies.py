"""Episodes of a robot whose body is chosen: the same start, other motions, and a change on the way."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from envtf_lit.errors import UserError
from envtf_lit.evaluation.bodies import changed_bodies, same_actions, travelled
from envtf_lit.robots.hidden_dynamics import Factors
from envtf_lit.robots.tasks import get_task

CHEETAH = get_task("halfcheetah-medium-hidden").robot
ACTIONS = np.random.default_rng(0).uniform(-1, 1, (12, 6)).astype(np.float32)
WEAK = Factors(strength=0.5)


class Same:
    """Does the same at every step."""

    def act(self, observation: Tensor, deterministic: bool = True, generator: torch.Generator | None = None) -> Tensor:
        return torch.full((len(observation), 6), 0.5)


def test_the_same_actions_begin_alike_and_lead_elsewhere():
    found = same_actions(CHEETAH, {"nominal": Factors(), "weak": WEAK, "again": Factors()}, ACTIONS, seed=3)
    env = get_task("halfcheetah-medium").robot.make()
    plain = [env.reset(seed=3)[0], *(env.step(action)[0] for action in ACTIONS)]
    assert np.array_equal(found["nominal"], np.array(plain, np.float32))
    assert np.array_equal(found["nominal"], found["again"])
    assert np.array_equal(found["weak"][0], found["nominal"][0])
    assert np.abs(found["weak"][1:] - found["nominal"][1:]).max(1).min() > 1e-3


def test_the_way_is_the_sum_of_the_speeds():
    (path,) = same_actions(CHEETAH, {"nominal": Factors()}, ACTIONS, seed=3).values()
    env = CHEETAH.make()
    env.reset(seed=3)
    env.apply(Factors())  # pyright: ignore[reportAttributeAccessIssue]
    places = [env.unwrapped.data.qpos[0]]  # pyright: ignore[reportAttributeAccessIssue]
    for action in ACTIONS:
        env.step(action)
        places.append(env.unwrapped.data.qpos[0])  # pyright: ignore[reportAttributeAccessIssue]
    way = travelled(CHEETAH, path)
    assert way[0] == 0 and way[-1] == pytest.approx(places[-1] - places[0], abs=0.03)


def test_a_body_changes_when_it_should_and_not_before():
    facts = dict(at=5, steps=9, episodes=2, seed=1)
    changed = changed_bodies(CHEETAH, Same(), Factors(), WEAK, **facts)
    unchanged = changed_bodies(CHEETAH, Same(), Factors(), Factors(), **facts)
    assert changed.targets.shape == (2, 9, 18) and changed.lengths.tolist() == [9, 9]
    assert torch.equal(changed.targets[:, :5], unchanged.targets[:, :5])
    assert (changed.targets[:, 5:] - unchanged.targets[:, 5:]).abs().amax(-1).min() > 1e-3
    assert torch.equal(changed.observations[:, 1:], changed.targets[:, :-1, :-1])
    assert not torch.equal(changed.observations[0, 0], changed.observations[1, 0])  # each start its own


def test_episodes_end_where_the_robot_falls():
    hopper = get_task("hopper-medium-hidden").robot

    class Kick(Same):
        def act(self, observation: Tensor, deterministic: bool = True, generator: torch.Generator | None = None):
            return torch.ones(len(observation), 3)

    found = changed_bodies(hopper, Kick(), Factors(), Factors(), at=2, steps=200, episodes=3, seed=0)
    assert 5 < int(found.lengths.max()) < 200
    assert not found.targets[~found.valid].any() and not found.actions[~found.valid].any()
    assert found.targets[found.valid].isfinite().all()


def test_a_robot_of_one_body_is_refused():
    plain = replace(CHEETAH, variant="")
    for call in (
        lambda: same_actions(plain, {"nominal": Factors()}, ACTIONS, seed=0),
        lambda: changed_bodies(plain, Same(), WEAK, WEAK, at=1, steps=2, episodes=1, seed=0),
    ):
        with pytest.raises(UserError, match="halfcheetah has one body"):
            call()
