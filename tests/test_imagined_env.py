"""The imagined environment: Gymnasium's checks, how episodes begin and end, its vector form, what it refuses."""

import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from envtf_lit.data.sources.files import save_dataset
from envtf_lit.errors import UserError
from envtf_lit.imagination.env import ImaginedEnv
from envtf_lit.imagination.vector_env import ImaginedVectorEnv
from envtf_lit.registration import ENV_ID
from envtf_lit.robots.tasks import ROBOTS
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.store import save_world_model
from envtf_lit.world_models.transformer import EnvironmentTransformer
from tests.analytic import linear_data, linear_world
from tests.logs import dataset_of_chains

DATA = linear_data((6, 9, 4))


def transformer(observation_dim: int = 3, action_dim: int = 1, **options: Any) -> EnvironmentTransformer:
    """A real world model with random weights, which looks back and is uncertain."""
    torch.manual_seed(0)
    sizes = dict(layers=2, heads=2, width=16, context=4, random_features=8) | options
    model = EnvironmentTransformer(observation_dim, action_dim, **sizes).eval()
    model.tail.fill_(0.3)
    for parameter in model.parameters():
        parameter.data *= 3
    return model.requires_grad_(False)


def imagined(model: Any = None, dataset: Any = DATA, **options: Any) -> ImaginedEnv:
    return ImaginedEnv(transformer() if model is None else model, dataset, **dict(novelty_limit=None) | options)


def ride(env: Any, steps: int, *, seed: int = 0) -> list[tuple]:
    """Steps under random actions, from the reset; begins anew where an episode ends."""
    env.action_space.seed(seed)
    observation, _ = env.reset(seed=seed)
    table: list[tuple] = [(observation,)]
    for _ in range(steps):
        step = env.step(env.action_space.sample())
        table.append(step)
        if step[2] or step[3]:
            table.append((env.reset()[0],))
    return table


# Gymnasium


def test_gymnasium_makes_it_from_folders_and_finds_nothing_wrong(tmp_path: Path):
    save_world_model(tmp_path / "model", transformer())
    save_dataset(DATA.with_split(0.3, 0), tmp_path / "data.h5")
    env = gymnasium.make(ENV_ID, world_model=tmp_path / "model", dataset=tmp_path / "data.h5", max_steps=5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*(infinity|normalized|different spec|not within|inf).*")
        check_env(env.unwrapped, skip_render_check=True)
    assert env.observation_space.shape == (3,) and env.action_space.low.tolist() == [-1.0]  # pyright: ignore[reportAttributeAccessIssue]
    vector = gymnasium.make_vec(ENV_ID, num_envs=2, world_model=transformer(), dataset=DATA, novelty_limit=None)
    assert isinstance(vector.unwrapped, ImaginedVectorEnv) and vector.reset(seed=0)[0].shape == (2, 3)


@pytest.mark.parametrize("order", ["envtf_lit, gymnasium", "gymnasium, envtf_lit"])
def test_importing_the_package_registers_it_without_torch(order: str):
    code = f"import sys, {order}; print('{ENV_ID}' in gymnasium.registry, 'torch' in sys.modules)"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown == "True False\n"


# steps


def test_a_step_is_the_models_own_after_the_whole_history():
    """Mean predictions along an episode longer than the context, as the model gives them after the last four pairs."""
    model = transformer()
    env, seen, done = imagined(model, mode="mean", max_steps=20), [], []
    env.action_space.seed(1)
    observation, _ = env.reset(options={"history": {"observations": DATA.observations[:1]}})
    for _ in range(8):
        seen.append(observation)
        action = env.action_space.sample()
        window, acts = torch.from_numpy(np.stack(seen[-4:])), torch.from_numpy(np.array(done[-3:], np.float32))
        state = model.init(window[None], acts.reshape(1, -1, 1), torch.tensor([len(window)]))
        _, p = model.step(state, torch.from_numpy(action)[None])
        observation, reward, _, _, info = env.step(action)
        done.append(action)
        np.testing.assert_allclose(observation, p.observation[0].numpy(), rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(
            [reward, info["uncertainty"], info["novelty"]],
            [float(p.reward), float(p.uncertainty), float(p.novelty)],  # pyright: ignore[reportArgumentType]
            rtol=1e-3,
            atol=1e-5,
        )


def test_drawn_outcomes_are_as_wide_as_predicted():
    world = linear_world(std=0.1, epistemic=0.2)
    env = imagined(world, max_steps=1)
    begin = {"history": {"observations": np.array([[1.0, 0.0, 0.0]], np.float32)}}
    env.reset(seed=0)
    drawn = []
    for _ in range(500):
        env.reset(options=begin)
        observation, reward, *_ = env.step(np.zeros(1, np.float32))
        drawn.append([*observation, reward])
    mean = [*world.matrix[:, 0].tolist(), 1.0]
    np.testing.assert_allclose(np.mean(drawn, 0), mean, atol=0.05)
    np.testing.assert_allclose(np.std(drawn, 0), np.full(4, 0.05**0.5), rtol=0.15)


def test_uncertainty_costs_its_penalty_and_the_models_own_reward_is_told():
    env = imagined(linear_world(std=0.1), mode="mean", penalty=3.0)
    observation, _ = env.reset(seed=0)
    _, reward, _, _, info = env.step(np.zeros(1, np.float32))
    assert info["reward"] == pytest.approx(float(observation.sum()), abs=1e-5)
    assert reward == pytest.approx(info["reward"] - 0.3, abs=1e-5)


def test_episodes_begin_in_the_log_with_the_steps_that_led_there():
    rows = {tuple(row.tolist()) for row in DATA.observations}
    env = imagined(history=3)
    begun = {tuple(env.reset(seed=seed)[0].tolist()) for seed in range(60)}
    assert begun <= rows and len(begun) > 12
    firsts = {tuple(DATA.observations[row].tolist()) for row in DATA.episode_starts}
    env = imagined(history=3, starts="episodes")
    assert {tuple(env.reset(seed=seed)[0].tolist()) for seed in range(30)} == firsts


def test_episodes_end_by_the_robots_rule_by_their_length_or_where_trust_is_lost():
    robot = ROBOTS["hopper"]
    fallen = np.array([[0.1, *[0.0] * 10]], np.float32)
    env = ImaginedEnv(EnsembleDynamics(11, 3, hidden=(8,)).eval(), task="hopper-medium", novelty_limit=None)
    assert env.dream.max_steps == robot.max_episode_steps
    env.reset(options={"history": {"observations": fallen}})
    _, _, terminated, truncated, info = env.step(np.zeros(3, np.float32))
    assert (terminated, truncated, info["lost_trust"]) == (True, False, False)
    with pytest.raises(UserError, match=r"over.*reset\(\)"):
        env.step(np.zeros(3, np.float32))
    env = imagined(linear_world(), max_steps=2)
    assert [step[2:4] for step in ride(env, 2)[1:3]] == [(False, False), (False, True)]
    env = imagined(replace(linear_world(), novelty=torch.full((32,), 1.5)), novelty_limit=1.0)
    *_, truncated, info = ride(env, 1)[1]
    assert truncated and info["lost_trust"] and info["novelty"] == 1.5


def test_what_is_no_number_never_goes_out():
    world = linear_world()
    world.matrix *= float("nan")
    begun, (observation, reward, terminated, truncated, info), *_ = ride(imagined(world), 1)
    assert np.array_equal(observation, begun[0]) and reward == 0.0
    assert truncated and not terminated and info["lost_trust"]


def test_the_robot_is_drawn_where_it_is(tmp_path: Path):
    model = transformer(11, 3)
    env = ImaginedEnv(model, task="hopper-medium", render_mode="rgb_array", novelty_limit=None)
    pictures = []
    for height in (1.25, 0.9):
        env.reset(options={"history": {"observations": np.array([[height, *[0.0] * 10]])}})
        pictures.append(env.render())
    assert pictures[0].shape == (240, 240, 3) and not np.array_equal(*pictures)
    env.step(np.zeros(3, np.float32))
    assert not np.array_equal(env.render(), pictures[1])  # pyright: ignore[reportArgumentType]
    assert imagined().render() is None


def test_environments_share_a_model():
    model = transformer()
    alone = ride(imagined(model, max_steps=6), 12)
    first, second = imagined(model, max_steps=6), imagined(model, max_steps=6)
    first.action_space.seed(0)
    observation, _ = first.reset(seed=0)
    assert np.array_equal(observation, alone[0][0])
    second.reset(seed=1)
    for expected in alone[1:6]:
        second.step(np.ones(1, np.float32))
        assert np.array_equal(first.step(first.action_space.sample())[0], expected[0])


# the vector form


def same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[name], other[name]) for name in one)
    if isinstance(one, np.ndarray) and one.dtype.hasobject:
        return all(same(a, b) for a, b in zip(one, other, strict=True))
    if one is None or other is None:
        return one is other
    return np.array_equal(one, other)


@pytest.mark.parametrize(("mode", "count"), [*((mode, 3) for mode in AutoresetMode), (AutoresetMode.SAME_STEP, 35)])
def test_the_vector_form_equals_single_ones_bit_for_bit(mode: AutoresetMode, count: int):
    """Beside Gymnasium's own vector of single environments; 35 are more than one block of rows."""
    options: dict[str, Any] = dict(max_steps=4, novelty_limit=1e9)
    model = transformer()
    ours = ImaginedVectorEnv(model, DATA, num_envs=count, autoreset_mode=mode, **options)
    theirs = SyncVectorEnv([lambda: ImaginedEnv(model, DATA, **options)] * count, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] == mode
    assert np.array_equal(ours.reset(seed=7)[0], theirs.reset(seed=7)[0])
    ours.action_space.seed(0)
    for t in range(11 if count == 3 else 5):
        if mode == AutoresetMode.DISABLED and t and t % 4 == 0:
            mask = np.arange(count) < count  # all of them have come to their end
            found, expected = (env.reset(options={"reset_mask": mask.copy()}) for env in (ours, theirs))
            assert same(found[0], expected[0])
        actions = ours.action_space.sample()
        for found, expected in zip(ours.step(actions), theirs.step(actions), strict=True):
            assert same(found, expected)


def test_masked_resets_leave_the_others_as_they_are():
    env = ImaginedVectorEnv(transformer(), DATA, num_envs=3, autoreset_mode="DISABLED", novelty_limit=None)
    before, _ = env.reset(seed=0)
    after, _ = env.reset(seed=[5, 6, 7], options={"reset_mask": np.array([False, True, False])})
    assert np.array_equal(before[[0, 2]], after[[0, 2]])
    assert np.array_equal(after[1], imagined().reset(seed=6)[0])


# what is refused


def refused(words: str, **given: Any) -> None:
    with pytest.raises(UserError, match=words):
        imagined(**given)


def test_bad_makings_end_in_one_sentence(tmp_path: Path):
    refused("size 5 and actions of size 1, and the dataset 3 and 1", model=transformer(5))
    refused("size 3 and actions of size 1, and the task's robot 11 and 3", dataset=None, task="hopper-medium")
    refused("nowhere", model=tmp_path / "nowhere")
    refused("nowhere.h5", dataset=tmp_path / "nowhere.h5")
    refused("did you mean 'hopper-medium'", dataset=None, task="hopper-medum")
    refused("action range: give a dataset", dataset=None)
    refused("actions are of size 1", dataset=None, action_low=[-1.0] * 2, action_high=[1.0] * 2)
    refused("max_steps is 0: take 1 or more", max_steps=0)
    refused("mode is 'meen': choose from mean, sample", mode="meen")
    refused("no robot to draw", render_mode="rgb_array")
    with pytest.raises(UserError, match="num_envs is 0"):
        ImaginedVectorEnv(linear_world(), DATA, num_envs=0)
    with pytest.raises(UserError, match="autoreset_mode is 'never': choose from NEXT_STEP"):
        ImaginedVectorEnv(linear_world(), DATA, autoreset_mode="never")


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (np.zeros(2), r"shape \(2,\).*have \(1,\)"),
        ([1.5], r"\[1\.5\] is outside its range"),
        ([float("nan")], "outside its range"),
        ("left", r"shape \(\)"),
    ],
)
def test_bad_actions_end_in_one_sentence(action: Any, words: str):
    env = imagined()
    with pytest.raises(UserError, match="none has begun"):
        env.step(np.zeros(1, np.float32))
    env.reset(seed=0)
    with pytest.raises(UserError, match=words):
        env.step(action)


@pytest.mark.parametrize(
    ("history", "words"),
    [
        ({"actions": []}, "the one given is not|give it so"),
        ({"observations": np.zeros((2, 4))}, r"shape \(2, 4\)"),
        ({"observations": np.zeros((2, 3))}, "0 actions"),
        ({"observations": np.full((1, 3), np.inf)}, "not finite"),
    ],
)
def test_bad_histories_end_in_one_sentence(history: dict[str, Any], words: str):
    with pytest.raises(UserError, match=words):
        imagined().reset(options={"history": history})


def test_without_a_log_an_episode_needs_a_history():
    env = imagined(dataset=None, action_low=[-1.0], action_high=[1.0])
    with pytest.raises(UserError, match="begins in a log, and this environment has none"):
        env.reset()
    seen, _ = env.reset(options={"history": {"observations": np.ones((2, 3)), "actions": np.zeros((1, 1))}})
    assert seen.tolist() == [1.0] * 3


def test_a_vector_says_which_episode_is_over():
    env = ImaginedVectorEnv(
        linear_world(), DATA, num_envs=2, autoreset_mode=AutoresetMode.DISABLED, max_steps=1, novelty_limit=None
    )
    with pytest.raises(UserError, match="has begun"):
        env.step(np.zeros((2, 1)))
    env.reset(seed=0)
    with pytest.raises(UserError, match=r"shape \(3, 1\)"):
        env.step(np.zeros((3, 1)))
    env.step(np.zeros((2, 1)))
    with pytest.raises(UserError, match="Episode 0 is over"):
        env.step(np.zeros((2, 1)))
    with pytest.raises(UserError, match="reset_mask of as many"):
        env.reset(options={"reset_mask": np.array([True])})


def test_a_log_of_another_robot_than_its_task_is_refused():
    with pytest.raises(UserError, match="robot 11 and 3"):
        ImaginedEnv(transformer(4, 2), dataset_of_chains("hopper-medium"))
