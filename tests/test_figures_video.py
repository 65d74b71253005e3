"""The real-versus-imagined video: with whatever GL there is, and without any."""

from typing import Any

import numpy as np
import pytest
import torch
from analytic import LinearWorld
from PIL import Image

from envtf_lit.errors import UserError
from envtf_lit.figures import video
from envtf_lit.policy import RandomPolicy
from envtf_lit.robots.render import GHOST, draw_with_ghost
from envtf_lit.robots.returns import Episode, evaluate_policy
from envtf_lit.robots.tasks import ROBOTS, Robot, get_task
from envtf_lit.world_models.forecast import Scale

HOPPER = ROBOTS["hopper"]
SCALE = Scale(torch.zeros(12), torch.ones(12), torch.ones(12, dtype=torch.bool))


def still_world(factor: float = 1.0) -> LinearWorld:
    """Nothing ever moves in this imagination (or all grows by `factor`)."""
    return LinearWorld(factor * torch.eye(11), torch.zeros(11, 3), observation_dim=11, action_dim=3)


def random_episode(robot: Robot) -> Episode:
    torch.manual_seed(0)
    limit = robot.action_limit * torch.ones(robot.action_dim)
    return evaluate_policy(RandomPolicy(-limit, limit), robot, episodes=1, seed=0, progress=False).median


@pytest.fixture(scope="module")
def episode() -> Episode:
    return random_episode(HOPPER)


def test_positions_follow_from_observations(episode):
    positions = video.imagined_positions(HOPPER, episode.observations, episode.positions[0])
    np.testing.assert_allclose(positions[:, 1:], episode.positions[:, 1:], atol=1e-6)
    np.testing.assert_allclose(positions[:, 0], episode.positions[:, 0], atol=0.01)


@pytest.mark.parametrize("task", ["walker2d-random", "ant-random", "ant-random-105d"])
def test_positions_of_other_robots(task):
    robot = get_task(task).robot
    played = random_episode(robot)
    positions = video.imagined_positions(robot, played.observations[:20], played.positions[0])
    np.testing.assert_allclose(positions, played.positions[:20], atol=0.05)


def test_states_that_are_not_finite_repeat_the_last_finite_one(episode):
    states = episode.observations[:6].copy()
    states[3:] = np.nan
    positions = video.imagined_positions(HOPPER, states, episode.positions[0])
    np.testing.assert_array_equal(positions[3:, 1:], np.repeat(positions[2:3, 1:], 3, 0))


def test_links_are_drawn_without_gl(episode):
    poses = episode.positions[[0, len(episode.actions)]]
    first, last = video._render(HOPPER, poses, 96, "disabled")
    assert first.shape == (96, 96, 3)
    robot = (np.abs(first.astype(int) - (204, 153, 102)).max(-1) < 12).mean()  # the model's own colour
    assert 0.01 < robot < 0.2
    assert (first != last).any(-1).mean() > 0.01


def test_a_ghost_stands_behind_the_robot_where_the_model_errs(episode, tmp_path):
    path = tmp_path / "ghost.gif"
    video.ghost_over_real(still_world(), episode, HOPPER, SCALE, path, frames=5)
    with Image.open(path) as movie:
        assert movie.size == (video.GHOST_SIZE, video.GHOST_SIZE + 2 * video.HEADER) and getattr(movie, "n_frames") == 5  # noqa: B009
        movie.seek(4)
        last = np.asarray(movie.convert("RGB")).astype(int)
    simulator: Any = HOPPER.make().unwrapped
    model, pose = simulator.model, episode.positions[:1]
    apart = pose + np.eye(1, pose.shape[1])  # a metre ahead
    pale = lambda frame: int((np.abs(frame.astype(int) - GHOST).sum(-1) < 30).sum())  # noqa: E731
    alone, both = (draw_with_ghost(model, pose, other, 96)[0] for other in (pose, apart))
    assert pale(both) > 5 * max(1, pale(alone)) and last.std() > 1.0


def test_video_shows_both_sides(episode, tmp_path):
    path = tmp_path / "video.gif"
    backend = video.real_vs_imagined(still_world(), episode, HOPPER, SCALE, path, frames=5)
    assert backend in video.BACKENDS
    with Image.open(path) as movie:
        assert getattr(movie, "n_frames", 1) == 5
        assert movie.size == (2 * video.SIZE + 4, video.SIZE + 2 * video.HEADER)
        first = np.asarray(movie.convert("RGB"))[video.HEADER : -video.HEADER]
        movie.seek(4)
        last = np.asarray(movie.convert("RGB"))[video.HEADER : -video.HEADER]
    np.testing.assert_array_equal(first[:, : video.SIZE], first[:, video.SIZE + 4 :])  # the same first state
    assert (last[:, : video.SIZE] != last[:, video.SIZE + 4 :]).any()


def test_an_imagination_that_explodes_is_still_a_video(episode, tmp_path):
    states, error = video._imagine(still_world(1e30), episode, SCALE, 6)
    assert not np.isfinite(states).all()
    assert error[-1] == np.inf
    video.real_vs_imagined(still_world(1e30), episode, HOPPER, SCALE, tmp_path / "video.gif", frames=3)
    with Image.open(tmp_path / "video.gif") as movie:
        assert getattr(movie, "n_frames", 1) == 3


def test_too_many_frames_are_refused(episode, tmp_path):
    with pytest.raises(UserError, match="151 were asked for"):
        video.real_vs_imagined(still_world(), episode, HOPPER, SCALE, tmp_path / "video.gif", frames=151)
    assert list(tmp_path.iterdir()) == []
