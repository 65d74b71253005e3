"""Errors by how much a model has seen, of a model whose errors are a known function of that."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from analytic import LinearWorld, linear_data, linear_world
from PIL import Image
from torch import Tensor

from envtf_lit.evaluation.in_context import (
    HISTORY,
    InContextError,
    doubt_by_history,
    errors_on_the_way,
    in_context_error,
    in_context_metrics,
    steps_to_settle,
    stretches,
)
from envtf_lit.figures.in_context import in_context_curves
from envtf_lit.world_models.forecast import Scale


class Remembering(LinearWorld):
    """The true world, plus an error in the first dimension that halves with every true state it is shown."""

    def init(self, observations: Tensor, actions: Tensor, lengths: Tensor, window: Tensor | None = None, **posterior):
        self.seen = 0
        return super().init(observations, actions, lengths)

    def observe(self, state: Tensor, observation: Tensor) -> Tensor:
        self.seen += 1
        return observation

    def step(self, state: Tensor, action: Tensor, **draw):
        state, prediction = super().step(state, action, **draw)
        mistake = torch.tensor([0.5**self.seen, 0.0, 0.0, 0.0])
        return state, replace(prediction, mean=prediction.mean + mistake)


def remembering() -> Remembering:
    world = linear_world()
    return Remembering(world.matrix, world.gain)


def test_errors_are_sorted_by_what_the_model_has_seen() -> None:
    data = linear_data((100, 100, 30))
    scale = Scale.of(data)
    found = in_context_error(remembering(), stretches(data, 20, seed=0), scale)
    one_step, open_loop = np.array(found.one_step), np.array(found.open_loop)
    assert one_step.shape == (3, 32) and open_loop.shape == (3, 25)
    unit = 1.0 / (scale.std[0].item() ** 2 * int(scale.live.sum()))  # nmse of an error of one
    expected = unit * 0.25 ** np.arange(8)
    np.testing.assert_allclose(one_step[:, :8], np.tile(expected, (3, 1)), rtol=1e-2)
    # the open loop is shown nothing more: its error stays that after 16 steps of history
    assert open_loop.max() < unit * 0.25**HISTORY * 1.1 + 1e-10


def test_doubt_is_the_error_beside_the_spread_that_is_told() -> None:
    data = linear_data((100, 100))
    scale, pieces = Scale.of(data), stretches(linear_data((100, 100)), 20, seed=0)
    found = doubt_by_history(remembering(), pieces, scale)
    unit = 1.0 / (scale.std[0].item() * int(scale.live.sum()) ** 0.5)
    np.testing.assert_allclose(found.error[:8], unit * 0.5 ** np.arange(8), rtol=1e-2)
    world = linear_world(std=0.3)
    told = doubt_by_history(world, pieces, scale).told
    expected = (0.3 / scale.std[scale.live]).square().mean().sqrt().item()
    np.testing.assert_allclose(told, expected, rtol=1e-5)


def test_errors_on_the_way_are_quartiles_of_each_step() -> None:
    data = linear_data((100, 100))
    scale = Scale.of(data)
    found = errors_on_the_way(remembering(), stretches(data, 20, seed=0), scale)
    assert found.shape[0] == 3 and (np.diff(found[1][:6]) < 0).all()


def test_a_curve_has_settled_once_it_is_near_its_end() -> None:
    curve = np.array([1.0, 1.0, 8.0, 4.0, 2.0, 1.4, 1.0, 1.0, 1.0, 1.0])
    assert steps_to_settle(curve, 2) == 3  # from 8 on: 1.4 is the first within 1.5 of 1
    assert steps_to_settle(curve, 0) == 0
    assert steps_to_settle(np.full(4, np.nan), 0) is None


def test_metrics_are_medians_and_shares_of_the_other_models() -> None:
    rng = np.random.default_rng(0)
    errors = {name: rng.lognormal(size=(11, 57)) for name in ("transformer", "context_1")}
    found = {name: InContextError.of(torch.tensor(e[:, :32]), torch.tensor(e[:, 32:])) for name, e in errors.items()}
    metrics = in_context_metrics(found)
    medians = {name: np.median(e, axis=0) for name, e in errors.items()}
    assert metrics["transformer.one_step"] == medians["transformer"][16]
    assert metrics["context_1.open_loop"] == medians["context_1"][-1]
    assert metrics["context_1.one_step_by_context"] == medians["context_1"][:32].tolist()
    shares = medians["transformer"] / medians["context_1"]
    assert metrics["transformer.one_step_vs_context_1"] == pytest.approx(shares[16])
    assert metrics["transformer.open_loop_vs_context_1"] == pytest.approx(shares[-1])


def test_the_figure_holds_every_curve(tmp_path) -> None:
    rng = np.random.default_rng(0)
    found = {
        robot: {
            name: InContextError.of(
                torch.tensor(rng.lognormal(size=(9, 32))), torch.tensor(rng.lognormal(size=(9, 25)))
            )
            for name in ("transformer", "context_1", "ensemble")
        }
        for robot in ("halfcheetah", "walker2d")
    }
    path = in_context_curves(found, tmp_path / "hidden.png")
    table = pd.read_csv(path.with_suffix(".csv"))
    assert len(table) == 2 * 3 * (32 + 25)
    row = table.query("robot == 'walker2d' and model == 'ensemble' and error == 'open_loop' and at == 25").iloc[0]
    assert row[["lower", "median", "upper"]].tolist() == pytest.approx(
        [curve[-1] for curve in found["walker2d"]["ensemble"].open_loop], rel=1e-5
    )
    with Image.open(path) as figure:
        assert figure.size[0] > 800
