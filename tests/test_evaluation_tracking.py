"""What is reported of a model along fresh episodes, on a world whose errors are known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import linear_data, linear_world

from envtf_lit.evaluation import tracking
from envtf_lit.evaluation.horizon import Steps
from envtf_lit.evaluation.physics import Ceiling
from envtf_lit.evaluation.tracking import fresh_episodes, track, track_ceiling, track_sampled
from envtf_lit.robots.tasks import ROBOTS, Task, get_task
from envtf_lit.world_models.forecast import Scale, whole_episodes

BRIEF_HOPPER = replace(ROBOTS["hopper"], max_episode_steps=50)


def test_a_perfect_model_is_censored_at_the_end_of_every_episode() -> None:
    data = linear_data((30, 50, 12))
    found = track(linear_world(), whole_episodes(data, 3, seed=0), Scale.of(data)).numbers
    for name in ("open_loop_0.01", "open_loop_0.1", "teacher_forced_0.01", "teacher_forced_0.1"):
        assert found[name] == pytest.approx((30 + 50 + 12) / 3) == found["mean_length"]
        assert found[f"{name}_median"] == 30 and found[f"{name}_censored"] == 1.0
    assert found["explosion_rate"] == 0.0 and found["trajectories"] == 3


def test_lengths_of_a_wrong_model_are_those_worked_out_by_hand() -> None:
    """The rotation is off by one rate: after h steps both rotating dimensions are off by 2 sin(h error / 2) |s|."""
    error, length = 0.02, 100
    data = linear_data((length,))
    states = [data.observations[0].astype(float)]
    matrix = linear_world().matrix.double().numpy()
    for _ in range(length):
        states.append(matrix @ states[-1])
    observations, following = np.array(states[:-1], np.float32), np.array(states[1:], np.float32)
    columns = dict(observations=observations, next_observations=following, rewards=observations.sum(1))
    data = replace(data, **columns, actions=np.zeros((length, 1), np.float32))
    trajectories, scale = whole_episodes(data, 1, seed=0), Scale.of(data)
    std = scale.std[scale.live].double().numpy()  # of the two rotating dimensions and the reward
    off = np.array([1j]) * 0.1  # the angle of a step, as a complex number
    start = complex(*states[0][:2])
    h = np.arange(1, length + 1)
    true, imagined = start * np.exp(off * h), start * np.exp((off + 1j * error) * h)
    before = start * np.exp(off * (h - 1)), start * np.exp((off + 1j * error) * (h - 1))  # rewards are sums of states
    rewards = [z.real + z.imag for z in before]
    differences = np.stack([(imagined - true).real, (imagined - true).imag, rewards[1] - rewards[0]])
    nmse = np.square(differences / std[:, None]).mean(0)
    found = track(linear_world(error), trajectories, scale)
    for threshold in (0.01, 0.1):
        assert found.numbers[f"open_loop_{threshold:g}"] == np.flatnonzero(nmse > threshold)[0]
    np.testing.assert_allclose(found.curves["open_loop"]["median"][:20], nmse[:20], rtol=1e-3)
    assert found.numbers["one_step_nrmse"] < 0.05 and found.numbers["teacher_forced_0.01"] == length


def test_typical_and_mean_error_differ_where_a_few_steps_are_bad() -> None:
    data = linear_data((40, 40))
    following = np.array(data.next_observations)
    following[7, 0] += 3.0
    data = replace(data, next_observations=following)
    found = track(linear_world(), whole_episodes(data, 2, seed=0), Scale.of(data)).numbers
    assert found["one_step_typical"] < 1e-3 < 0.05 < found["one_step_nrmse"]


def test_an_exploding_model_is_counted_and_leaves_finite_numbers() -> None:
    data, exploding = linear_data((60, 60)), linear_world()
    exploding.matrix = 1e3 * exploding.matrix
    trajectories, scale = whole_episodes(data, 2, seed=0), Scale.of(data)
    found = track(exploding, trajectories, scale) | track_sampled(exploding, trajectories, scale, seed=0)
    assert found.numbers["explosion_rate"] == found.numbers["explosion_rate_standing"] == 1.0
    fallen = track(exploding, trajectories, scale, lambda states: states.abs().amax(-1) > 5 * scale.std.max())
    assert fallen.numbers.items() <= (found.numbers | {"explosion_rate_standing": 0.0}).items()
    assert found.numbers["open_loop_0.1"] == 0.0 == found.numbers["open_loop_0.1_censored"]
    assert all(math.isfinite(value) for value in found.numbers.values())
    assert all(np.isfinite(column).all() for run in found.curves.values() for column in run.values())


def test_drawn_rollouts_leave_the_record_sooner_and_have_a_seed() -> None:
    data = linear_data((80, 80, 80))
    trajectories, scale, model = whole_episodes(data, 3, seed=0), Scale.of(data), linear_world(std=0.1)
    drawn = track_sampled(model, trajectories, scale, seed=3).numbers
    assert drawn["sampled_open_loop_0.1"] < 40 < track(model, trajectories, scale).numbers["open_loop_0.1"]
    assert drawn == track_sampled(model, trajectories, scale, seed=3).numbers


def test_a_ceiling_has_numbers_and_a_curve_of_its_name() -> None:
    error = torch.tensor([[0.0, 0.05, torch.inf]] * 4 + [[0.0, 0.05, 0.06]])
    trajectories = whole_episodes(linear_data((3,) * 5), 5, seed=0)
    outcomes = torch.zeros(5, 3, 4)
    outcomes[0, 1:, 0] = outcomes[1, 2:, 0] = outcomes[4, :, 0] = -1.0  # falls, the last one without exploding
    run = Ceiling(0.1, {0.01: Steps.within(error, trajectories.lengths, 0.01)}, trajectories, outcomes, error)
    found = track_ceiling("most", run, lambda states: states[..., 0] < 0.0)
    assert found.numbers["most_0.01"] == 1.0 and found.numbers["most_0.01_censored"] == 0.0
    assert found.curves["most"]["median"] == pytest.approx([1e-8, 0.05, 1e8])
    assert found.numbers["most_explosion_rate"] == pytest.approx(0.8)
    assert found.numbers["most_explosion_rate_standing"] == pytest.approx(0.4)


@pytest.mark.parametrize(("task", "count"), [(Task(BRIEF_HOPPER, "expert"), 12), (get_task("walker2d-random"), 40)])
def test_fresh_episodes_are_whole_and_as_many_as_asked_for(
    task: Task, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tracking, "PROBE", 500)  # too few, so that more are collected
    found = fresh_episodes(task, count, seed=5)
    assert len(found.episode_starts) == count
    over = found.terminated[found.episode_ends - 1] | (found.episode_lengths == task.robot.max_episode_steps)
    assert over.all()
    if task.tier == "expert":
        assert (found.episode_lengths == 50).mean() > 0.9
    again = fresh_episodes(task, count, seed=6)
    assert not np.array_equal(again.observations[0], found.observations[0])
