"""Plots: written whole, the same bytes every time, with the numbers behind them, and leaving matplotlib as it was."""

import hashlib
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest
import torch
from analytic import linear_data, linear_world
from PIL import Image

from envtf_lit.evaluation.horizon import horizon_report
from envtf_lit.figures import gallery, learning
from envtf_lit.figures.style import COLOURS, drawing, featured, model_looks, observation_labels
from envtf_lit.robots.returns import Episode, Returns
from envtf_lit.robots.tasks import ROBOTS
from envtf_lit.world_models.forecast import Scale, whole_episodes

HOPPER = ROBOTS["hopper"]
WORLD_MODEL_CURVES = pd.DataFrame(
    {
        "epoch": [0, 0, 1, 1],
        "step": [99, 99, 199, 199],
        "train/loss": [np.nan, 1.0, np.nan, 0.5],
        "val/loss": [1.2, np.nan, 0.7, np.nan],
        "val/open_loop_error": [0.5, np.nan, 0.01, np.nan],
    }
)
POLICY_CURVES = pd.DataFrame({"step": [0, 1, 2], "train/q_data": [1.0, 2.0, 3.0], "train/alpha": [1.0, np.nan, 0.5]})
PLOTS = (
    "dataset_returns", "world_model_curves", "horizon", "one_step", "calibration", "traces", "rollout_uncertainty",
    "scores", "policy_curves",
)  # fmt: skip


def some_returns(level: float) -> Returns:
    values = level + np.arange(5.0)
    episode = Episode(0, np.zeros((2, 3)), np.zeros((1, 1)), np.zeros(1), np.zeros((2, 6)))
    return Returns(returns=values, lengths=np.ones(5), scores=values, median=episode)


def draw_all(folder: Path) -> Path:
    data = linear_data((60, 90, 40, 70, 55, 80), noise=0.02)
    scale = Scale.of(data)
    report = horizon_report(linear_world(0.02, std=0.02), whole_episodes(data, 6, seed=0), scale)
    gallery.draw_dataset(data, "zoo", folder)
    gallery.draw_world_model(report, scale, HOPPER, WORLD_MODEL_CURVES, folder)
    gallery.draw_rollouts(np.repeat(np.arange(3), 50), np.linspace(0.1, 1.0, 150), folder)
    returns = {name: some_returns(level) for name, level in (("bc", 5.0), ("cql", 20.0), ("et_cql", 30.0))}
    gallery.draw_policies(data, "zoo", HOPPER, returns, {"cql": POLICY_CURVES, "et_cql": POLICY_CURVES + 1}, folder)
    return folder


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> Path:
    return draw_all(tmp_path_factory.mktemp("plots"))


def digests(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def test_every_plot_is_a_picture_with_its_numbers(drawn):
    expected = {f"{name}.{suffix}" for name in PLOTS for suffix in ("png", "csv")} | {"horizon_steps.csv"}
    assert set(digests(drawn)) == expected
    for path in drawn.glob("*.png"):
        with Image.open(path) as picture:
            assert "Software" not in picture.info
            assert min(picture.size) >= 300
            assert len(picture.convert("RGB").getcolors(1 << 24) or []) > 20  # something was drawn
    for path in drawn.glob("*.csv"):
        assert len(pd.read_csv(path)) > 0


def test_plots_have_the_same_bytes_every_time(drawn, tmp_path):
    np.random.seed(1)  # noqa: NPY002 -- no plot may depend on the global generators
    torch.manual_seed(1)
    assert digests(draw_all(tmp_path)) == digests(drawn)


def test_the_numbers_behind_the_plots_are_right(drawn):
    steps = pd.read_csv(drawn / "horizon_steps.csv")
    assert list(steps["run"]) == ["open loop", "open loop", "teacher-forced", "teacher-forced"]
    scores = pd.read_csv(drawn / "scores.csv")
    assert scores.loc[scores["policy"] == "et_cql", "score"].tolist() == [30.0, 31.0, 32.0, 33.0, 34.0]
    uncertainty = pd.read_csv(drawn / "rollout_uncertainty.csv")
    assert list(uncertainty["transitions"]) == [50, 50, 50]
    assert uncertainty["median"].is_monotonic_increasing


def test_settings_of_matplotlib_survive(tmp_path):
    before, backend = dict(matplotlib.rcParams), matplotlib.get_backend()
    with drawing(tmp_path / "a.png", (3, 2)) as (_, axes):
        axes[0, 0].plot([1, 2])
    assert dict(matplotlib.rcParams) == before
    assert matplotlib.get_backend() == backend


def test_nothing_is_left_when_drawing_fails(tmp_path):
    with pytest.raises(ZeroDivisionError), drawing(tmp_path / "a.png", (3, 2)):
        _ = 1 / 0
    assert list(tmp_path.iterdir()) == []


def test_curves_keep_every_value_and_forget_empty_cells():
    table = learning.tidy_curves({"world_model": WORLD_MODEL_CURVES})
    assert len(table) == 6
    assert set(table["split"]) == {"train", "val"}
    assert set(table["clock"]) == {"step"}
    held_out = table[(table["split"] == "val") & (table["quantity"] == "loss")]
    assert list(held_out["at"]) == [99, 199]
    assert list(held_out["value"]) == [1.2, 0.7]


@pytest.mark.parametrize("name", ROBOTS)
def test_labels_name_every_dimension_once(name):
    robot = ROBOTS[name]
    labels = observation_labels(name, robot.observation_dim)
    assert len(labels) == len(set(labels)) == robot.observation_dim
    assert labels[featured(robot.observation_dim)[2]] == "x velocity (m/s)"


def test_other_robots_have_numbered_labels():
    assert observation_labels(None, 2) == ["s[0]", "s[1]"]
    assert featured(1) == [0]
    assert featured(2) == [0, 1]


def test_models_of_no_colour_of_their_own_are_told_apart() -> None:
    looks = model_looks(["transformer", *(f"remedy_{i}" for i in range(11))])
    assert looks["transformer"].colour == COLOURS["transformer"] and looks["remedy_3"].label == "remedy_3"
    assert len({(look.colour, str(look.line), look.marker) for look in looks.values()}) == 12
