"""Learning in an environment: the replay's rows against a log's, runs that go on to the same bits, what is refused."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.loaders import Transitions
from envtf_lit.errors import UserError
from envtf_lit.online.data import as_dataset, joined
from envtf_lit.online.interaction import Interaction
from envtf_lit.online.match import check_match, differences, environment_of
from envtf_lit.online.replay import Replay
from envtf_lit.robots.environments import action_limits, robot_in
from envtf_lit.robots.tasks import get_task
from tests.walker import walker_dataset

HOPPER = robot_in("hopper")


def random_actions(environments: int, robot: Any = HOPPER, seed: int = 0) -> Any:
    """Uniform actions, from a stream of their own."""
    generator = torch.Generator().manual_seed(seed)
    return lambda _: 2.0 * torch.rand(environments, robot.action_dim, generator=generator) - 1.0


def lived(environments: int, steps: int) -> list[dict[str, Tensor]]:
    """Rows of Hopper under random actions, which falls every twenty steps or so."""
    interaction, act = Interaction(HOPPER, environments, seed=0), random_actions(environments)
    return [interaction.step(act) for _ in range(steps)]


def logged(steps: list[dict[str, Tensor]]) -> OfflineDataset:
    """The same as a dataset."""
    return as_dataset(joined(steps), len(steps[0]["rewards"]), action_limits(HOPPER))


# the replay


@pytest.mark.parametrize("environments", [1, 3])
@pytest.mark.parametrize("n_step", [1, 4])
def test_what_is_drawn_is_what_a_log_of_the_same_episodes_gives(
    environments: int, n_step: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the log is cut it says so, which here is at the newest rows."""
    steps = lived(environments, 90)
    monkeypatch.setattr("envtf_lit.online.replay.FIRST_SIZE", 16)  # it grows on the way
    replay, generator = Replay(environments, 1_000), torch.Generator()
    for rows in steps:
        replay.add(rows)
        replay.draw(64, generator, discount=0.9, n_step=n_step)  # also when it is full
    log = Transitions(logged(steps), discount=0.9, n_step=n_step)
    place = torch.arange(90 * environments)  # of the replay's rows, (T, E), in the log, (E, T)
    place = place % environments * 90 + place // environments
    monkeypatch.setattr(torch, "randint", lambda low, high, shape, **_: torch.arange(low, high))
    drawn, expected = replay.draw(len(place), torch.Generator(), discount=0.9, n_step=n_step), log[place]
    assert drawn.keys() == expected.keys()
    for name in drawn.keys() - {"returns", "tails", "last_observations"}:
        torch.testing.assert_close(drawn[name], expected[name], msg=name)
    assert drawn["returns"].isnan().all()
    assert 0 < (drawn["discounts"] == 0).sum() < len(place)  # some fell


def test_the_oldest_transitions_leave_and_what_is_kept_comes_back() -> None:
    replay, steps = Replay(2, 31), lived(2, 40)  # rounded up to 32
    for rows in steps:
        replay.add(rows)
    assert len(replay) == 32
    newest = torch.cat([rows["rewards"] for rows in steps[-16:]])
    torch.testing.assert_close(replay.state_dict()["rewards"], newest)
    assert replay.largest_reward == float(newest.abs().max())
    for capacity, kept in ((32, 32), (100, 32), (8, 8)):
        other = Replay(2, capacity)
        other.load_state_dict(replay.state_dict())
        assert torch.equal(other.state_dict()["rewards"], newest[-kept:])
        other.add(steps[0])
        expected = torch.cat([newest, steps[0]["rewards"]])[-min(capacity, kept + 2) :]
        assert torch.equal(other.state_dict()["rewards"], expected)
    empty = Replay(2, 8)
    empty.load_state_dict(Replay(2, 8).state_dict())
    assert len(empty) == 0 and empty.largest_reward == 0.0


# the environments


def test_transitions_are_the_environments_own() -> None:
    (rows,) = lived(1, 1)
    env = HOPPER.make()
    first = int(np.random.SeedSequence([0, 0, 0]).generate_state(1)[0])
    observation, _ = env.reset(seed=first)
    following, reward, *_ = env.step(rows["actions"][0].numpy())
    np.testing.assert_array_equal(rows["observations"][0], observation.astype(np.float32))
    np.testing.assert_array_equal(rows["next_observations"][0], following.astype(np.float32))
    assert float(rows["rewards"][0]) == np.float32(reward)


def test_an_episode_that_is_over_begins_anew_and_its_return_is_noted() -> None:
    interaction, act = Interaction(HOPPER, 2, seed=0), random_actions(2)
    steps = [interaction.step(act) for _ in range(60)]
    data = logged(steps)
    whole = data.terminated[data.episode_ends - 1]
    assert sorted(interaction.finished) == pytest.approx(sorted(data.episode_returns[whole]), rel=1e-5)
    assert interaction.steps == 120 == len(data) and whole.sum() > 2
    for rows, after in pairwise(steps):
        goes_on = ~rows["terminated"]
        assert torch.equal(after["observations"][goes_on], rows["next_observations"][goes_on])
    assert len(np.unique(data.observations[data.episode_starts][:, 0])) == len(data.episode_starts)  # each its own


@pytest.mark.parametrize("environment", ["hopper", "Pendulum-v1", "hopper-medium-hidden"])
def test_an_interrupted_interaction_goes_on_to_the_same_bits(environment: str) -> None:
    robot = robot_in(environment)
    first, act = Interaction(robot, 2, seed=1), random_actions(2, robot)
    for _ in range(75):
        first.step(act)
    second = Interaction(robot, 2, seed=1)
    second.load_state_dict(first.state_dict())
    for _ in range(40):
        action = act(None)
        a, b = (interaction.step(lambda _, action=action: action) for interaction in (first, second))
        assert all(torch.equal(a[name], b[name]) for name in a)
    assert first.finished[-1:] == second.finished[-1:] and first.steps == second.steps == 230


def test_where_an_interaction_cannot_go_on_it_says_so() -> None:
    interaction = Interaction(HOPPER, 2, seed=0)
    interaction.step(random_actions(2))
    with pytest.raises(UserError, match=r"checkpoint is of 2 environments, and --data.environments is 1"):
        Interaction(HOPPER, 1, seed=0).load_state_dict(interaction.state_dict())
    with pytest.raises(UserError, match="Hopper-v5 does not come to the same place by the same actions"):
        Interaction(HOPPER, 2, seed=1).load_state_dict(interaction.state_dict())
    with pytest.raises(UserError, match=r"asks for the action .*nan.* after 2 steps: its training diverged"):
        interaction.step(lambda observation: torch.full((2, 3), torch.nan))


# whether log and environment are of one kind


def test_an_environment_is_told_by_the_log_or_by_name() -> None:
    assert environment_of(walker_dataset()) == "hopper-medium-replay"
    for log, reason in ((None, "There is no log"), (replace(walker_dataset(), task=None), "The log names no task")):
        with pytest.raises(UserError, match=f"{reason} to tell the environment by: give --data.environment"):
            environment_of(log)


@pytest.mark.parametrize(
    ("changes", "environment", "said"),
    [
        ({}, "hopper", ""),
        ({"task": None}, "hopper", ""),
        ({}, "hopper-medium-v4", "the log is of Hopper-v5, this is Hopper-v4"),
        ({}, "hopper-medium-hidden", "the log's Hopper-v5 is the plain one, this is the hidden one"),
        ({"action_low": -2 * np.ones(3, np.float32)}, "hopper", "actions go from [-2.0, -2.0, -2.0] to"),
    ],
)
def test_what_tells_log_and_environment_apart_is_said_in_a_sentence(
    changes: dict[str, Any], environment: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log, robot = replace(walker_dataset(), **changes), robot_in(environment)
    check_match(log, robot, action_limits(robot))
    warned = capsys.readouterr().err
    assert said in warned and (warned == "") is (said == "") and warned.count("\n") == (1 if said else 0)


def test_longer_episodes_than_the_environment_has_are_said() -> None:
    robot = replace(HOPPER, max_episode_steps=5)
    assert differences(walker_dataset(), robot, action_limits(HOPPER)) == [
        "the log's episodes have up to 20 steps, this one's at most 5"
    ]


def test_other_dimensions_are_refused() -> None:
    ant = robot_in("ant")
    with pytest.raises(UserError, match="log has 11 observations and 3 actions, and Ant-v5 has 27 and 8"):
        check_match(walker_dataset(), ant, action_limits(ant))


# environments by name


@pytest.mark.parametrize("name", ["hopper", "Hopper-v5", "hopper-medium"])
def test_a_robot_of_ours_has_several_names(name: str) -> None:
    assert robot_in(name) == HOPPER


def test_environments_of_gymnasium_are_robots_of_which_little_is_known() -> None:
    pendulum = robot_in("Pendulum-v1")
    assert (pendulum.observation_dim, pendulum.action_dim, pendulum.max_episode_steps) == (3, 1, 200)
    assert np.isnan(pendulum.normalised_score(-200.0))
    low, high = action_limits(pendulum)
    assert (low.tolist(), high.tolist()) == ([-2.0], [2.0])
    assert robot_in("Ant-v5") == get_task("ant-medium-105d").robot != robot_in("ant")


class Unbounded(gymnasium.Env[np.ndarray, np.ndarray]):
    """An environment whose actions have no limit."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    action_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("Pendulm-v1", "There is no environment 'Pendulm-v1': did you mean 'Pendulum-v1'"),
        ("a/b/c", "There is no environment 'a/b/c': give a robot such as hopper"),
        ("CartPole-v1", "The actions of CartPole-v1 are a Discrete, and policies here take and give vectors"),
        ("FrozenLake-v1", "The observations of FrozenLake-v1 are a Discrete"),
        ("test/Unbounded-v0", "takes actions from -inf to inf, without a bound"),
    ],
)
def test_environments_that_are_none_for_policies_are_refused(name: str, sentence: str) -> None:
    gymnasium.register("test/Unbounded-v0", entry_point=lambda **_: Unbounded())
    try:
        with pytest.raises(UserError, match=sentence):
            robot_in(name)
    finally:
        del gymnasium.registry["test/Unbounded-v0"]
