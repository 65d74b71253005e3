"""What the tutorials look at: coverage of a log, attention's weights, honest spreads, true errors, the toy world."""

import numpy as np
import pytest
import torch
from analytic import linear_data, linear_world
from torch import Tensor

from envtf_lit.evaluation import toy
from envtf_lit.evaluation.attention import attention_weights, by_steps_back
from envtf_lit.evaluation.coverage import nearest, visits
from envtf_lit.evaluation.physics import Physics
from envtf_lit.evaluation.reliability import errors_by_step, imagined_errors, novelty_map, reliability
from envtf_lit.imagination.rollouts import Rollouts
from envtf_lit.robots.tasks import ROBOTS, get_task
from envtf_lit.world_models.forecast import Forecast, Scale, Trajectories, forecast, whole_episodes
from envtf_lit.world_models.transformer import EnvironmentTransformer
from envtf_lit.zoo.collect import collect

# a log's coverage


def test_each_row_counts_in_its_cell_and_shares_are_of_cells_that_any_log_visits() -> None:
    whole = linear_data((30, 40, 50))
    part = whole.select([0])
    found = visits({"whole": whole, "part": part}, (0, 1), bins=5)
    assert found.counts["whole"].sum() == len(whole) and found.counts["part"].sum() == len(part)
    x, y = whole.observations[7, :2]
    cell = np.searchsorted(found.x_edges, x, side="right") - 1, np.searchsorted(found.y_edges, y, side="right") - 1
    assert found.counts["whole"][cell] >= 1
    assert found.share("whole") == 1.0
    both = (found.counts["part"] > 0) & (found.counts["whole"] > 0)
    assert found.share("part") == both.sum() / (found.counts["whole"] > 0).sum() < 1.0


def test_the_nearest_row_in_units_of_each_dimensions_spread() -> None:
    rows = np.array([[0.0, 0.0, 5.0], [2.0, 0.0, 5.0], [0.0, 200.0, 5.0], [2.0, 200.0, 5.0]], np.float32)
    index, distance = nearest(np.array([[1.8, 190.0, 9.0], [0.0, 0.0, 0.0]], np.float32), rows)
    assert index.tolist() == [3, 0]
    # each spread is half the range, 1 and 100; the third dimension is constant and does not count
    np.testing.assert_allclose(distance, [np.sqrt((0.2**2 + 0.1**2) / 2), 0.0], atol=1e-6)


# attention


@torch.no_grad()
def test_attention_weights_are_those_that_the_model_mixes_with() -> None:
    model = EnvironmentTransformer(3, 2, layers=2, heads=2, width=16, context=4).eval()
    torch.nn.init.normal_(model.blocks[0].attention.qkv.weight)  # pyright: ignore[reportArgumentType,reportAttributeAccessIssue]
    observations, actions = torch.randn(2, 9, 3), torch.randn(2, 9, 2)
    weights, hidden = attention_weights(model, observations, actions)
    torch.testing.assert_close(hidden, model.encode(observations, actions, cached=False)[0])
    assert weights.shape == (2, 2, 2, 9, 9)
    torch.testing.assert_close(weights.sum(-1), torch.ones(2, 2, 2, 9))
    steps = torch.arange(9)
    back = steps[:, None] - steps
    assert (weights[..., (back < 0) | (back > 3)] == 0).all()
    mean = by_steps_back(weights, 4)
    torch.testing.assert_close(mean.sum(-1), torch.ones(2, 2))
    torch.testing.assert_close(mean[1, 0, 2], weights[:, 1, 0, steps[3:], steps[3:] - 2].mean())


# spreads and errors


def test_reliability_is_on_the_line_where_spreads_are_as_large_as_errors() -> None:
    generator, shape = torch.Generator().manual_seed(0), (40, 100, 4)
    std = torch.exp(torch.randn(shape, generator=generator))
    targets = std * torch.randn(shape, generator=generator)
    rows = Trajectories(targets[..., :3], targets[..., :1], targets, torch.full((40,), 100))
    scale = Scale(torch.zeros(4), torch.ones(4), torch.tensor([True, True, False, True]))
    honest = reliability(Forecast(torch.zeros(shape), std), rows, scale, parts=6)
    assert honest["predicted"].is_monotonic_increasing and len(honest) == 6
    np.testing.assert_allclose(honest["observed"] / honest["predicted"], 1.0, atol=0.1)
    boastful = reliability(Forecast(torch.zeros(shape), 0.5 * std), rows, scale, parts=6)
    np.testing.assert_allclose(boastful["observed"] / boastful["predicted"], 2.0, atol=0.2)


def rollouts(observations: Tensor, actions: Tensor, following: Tensor, valid: Tensor) -> Rollouts:
    grid = valid.shape
    nothing, flags = torch.zeros(grid), torch.zeros(grid, dtype=torch.bool)
    return Rollouts(
        observations, actions, nothing, following, flags, flags, torch.zeros(*grid, 12), nothing, valid=valid
    )  # fmt: skip


def test_the_true_error_of_an_imagined_step_is_what_mujoco_makes_of_the_same_state() -> None:
    log = collect(get_task("hopper-medium"), 60, seed=0, workers=1, progress=False)
    rows = slice(12, 18)
    observations, actions, following = (
        torch.from_numpy(column[rows])[:, None] for column in (log.observations, log.actions, log.next_observations)
    )
    valid = torch.tensor([True, True, True, True, False, True])[:, None]
    off = following + 0.5 * torch.eye(11)[3]  # one of eleven dimensions, by half a standard deviation
    scale = Scale(torch.zeros(12), torch.ones(12), torch.ones(12, dtype=torch.bool))
    physics = Physics(ROBOTS["hopper"])
    true = imagined_errors(rollouts(observations, actions, following, valid), physics, scale)
    wrong = imagined_errors(rollouts(observations, actions, off, valid), physics, scale)
    assert (true[valid] < 5e-3).all() and true[~valid].isnan().all()
    torch.testing.assert_close(wrong[valid], torch.full((5,), 0.5 / 11**0.5).double(), atol=5e-3, rtol=0)


def test_errors_by_step_leave_out_what_is_not_known() -> None:
    error = torch.full((2, 8), torch.nan).double()
    error[0, :5] = torch.arange(5.0)
    error[1, :4] = 1.0
    valid = torch.ones(2, 8, dtype=torch.bool)
    valid[1, 2:] = False
    table = errors_by_step(error, valid)
    assert table.iloc[0].tolist() == [1.0, 1.0, 2.0, 3.0, 1.0]
    assert table.iloc[1][["median", "running"]].isna().tolist() == [True, False] and table["running"][1] == 0.25


def test_a_map_of_novelty_varies_two_dimensions_and_goes_beyond_the_log() -> None:
    data = linear_data((40, 50))
    model = linear_world(novelty=torch.arange(36.0))
    x, y, novelty = novelty_map(model, data, (0, 1), bins=6, margin=0.25)
    low, high = data.observations[:, 0].min(), data.observations[:, 0].max()
    np.testing.assert_allclose([x[0], x[-1]], [low - 0.25 * (high - low), high + 0.25 * (high - low)], rtol=1e-5)
    np.testing.assert_array_equal(novelty, np.arange(36.0).reshape(6, 6))
    assert len(y) == 6


# the toy world


def test_the_toys_log_has_a_gap_and_noise_as_large_as_it_says() -> None:
    log = toy.toy_log(4_000, seed=0)
    x, following = log.observations[:, 0], log.next_observations[:, 0]
    assert not ((x > toy.SEEN[0][1]) & (x < toy.SEEN[1][0])).any() and len(log.episode_starts) == 200
    mean, std = toy.toy_truth(x)
    for side, noise in ((x < 0, toy.QUIET), (x > 0, toy.LOUD)):
        assert (std[side] == noise).all()
        assert (following - mean)[side].std() == pytest.approx(noise, rel=0.05)


def test_beliefs_are_the_models_predictions() -> None:
    model = EnvironmentTransformer(1, 1, layers=1, heads=1, width=8, context=1).eval()
    log = toy.toy_log(40, seed=0)
    model.normaliser.fit(log)
    found = toy.beliefs(model, log.observations[:, 0])
    recorded = whole_episodes(log, 2, seed=0)
    still = Trajectories(*(getattr(recorded, name) for name in ("observations", "actions", "targets", "lengths")))
    still.actions.zero_()
    forced = forecast(model, still, feedback="recorded")
    np.testing.assert_allclose(found.mean, forced.mean[..., 0].flatten(), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found.std, forced.std[..., 0].flatten(), rtol=1e-4)
