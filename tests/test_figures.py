"""Plots: written whole, the same bytes every time, with the numbers behind them, and leaving matplotlib as it was."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import combinations
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
import pytest
import torch
from analytic import linear_data, linear_world
from made_up_runs import some_estimates, some_frontier, some_returns, some_rollouts
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from envtf_lit.evaluation.horizon import horizon_report
from envtf_lit.evaluation.metrics import held_out_metrics
from envtf_lit.figures import gallery, learning, scores
from envtf_lit.figures.style import COLOURS, drawing, featured, model_looks, observation_labels
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
CLONE_CURVES = pd.DataFrame({"step": [0, 1, 2], "train/clone_loss": [3.0, 2.0, 1.0]})
PLOTS = (
    "dataset_returns", "world_model_curves", "horizon", "one_step", "calibration", "traces", "rollout_uncertainty",
    "scores", "policy_curves", "frontier",
)  # fmt: skip


def draw_all(folder: Path) -> Path:
    data = linear_data((60, 90, 40, 70, 55, 80), noise=0.02)
    scale = Scale.of(data)
    report = horizon_report(linear_world(0.02, std=0.02), whole_episodes(data, 6, seed=0), scale)
    gallery.draw_dataset(data, "zoo", folder)
    gallery.draw_world_model(report, scale, HOPPER, WORLD_MODEL_CURVES, folder)
    gallery.draw_rollouts(some_rollouts(), folder)
    returns = {name: some_returns(level, 5) for name, level in (("bc", 5.0), ("cql", 20.0), ("et_cql", 30.0))}
    labels = {"bc": "BC", "cql": "CQL", "et_cql": "ET + CQL"}
    gallery.draw_scores(data, "minari", HOPPER, returns, labels, folder)
    curves = {"bc": CLONE_CURVES, "cql": POLICY_CURVES, "et_cql": POLICY_CURVES + 1}
    gallery.draw_policy_curves(curves, labels, folder)
    held_out = held_out_metrics(some_estimates())
    gallery.draw_frontiers({"et_cql": some_frontier()}, held_out, data, "zoo", labels, {}, folder)
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


@pytest.mark.slow
def test_plots_have_the_same_bytes_every_time(drawn, tmp_path):
    np.random.seed(1)  # noqa: NPY002 -- no plot may depend on the global generators
    torch.manual_seed(1)
    assert digests(draw_all(tmp_path)) == digests(drawn)


def test_the_numbers_behind_the_plots_are_right(drawn):
    steps = pd.read_csv(drawn / "horizon_steps.csv")
    assert list(steps["run"]) == ["open loop", "open loop", "teacher-forced", "teacher-forced"]
    table = pd.read_csv(drawn / "scores.csv")
    assert table.loc[(table["kind"] == "policy") & (table["name"] == "et_cql"), "score"].tolist() == [
        30.0,
        31.0,
        32.0,
        33.0,
        34.0,
    ]
    uncertainty = pd.read_csv(drawn / "rollout_uncertainty.csv")
    assert list(uncertainty["transitions"]) == [50, 50, 50]
    assert uncertainty["median"].is_monotonic_increasing


def test_estimates_stand_beside_the_record_and_what_the_model_makes_of_it(tmp_path: Path) -> None:
    gallery.draw_estimates(some_estimates(), {"clone": "BC", "plain": "CQL", "dreamer": "ET + CQL"}, tmp_path)
    table = pd.read_csv(tmp_path / "scores.csv")
    means = {key: group["score"].mean() for key, group in table.groupby(["kind", "name"], sort=False)}
    references = {("reference", "recorded"): 310.0, ("reference", "imagined"): 320.0}
    policies = {("policy", "clone"): 401.0, ("policy", "plain"): 901.0, ("policy", "dreamer"): 201.0}
    assert means == references | policies


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that are drawn, once they are."""
    seen: list[Figure] = []

    @contextmanager
    def watched(*args: Any) -> Iterator[Any]:
        with drawing(*args) as (figure, axes):
            seen.append(figure)
            yield figure, axes

    for module in (learning, scores):
        monkeypatch.setattr(module, "drawing", watched)
    return seen


LONG = {f"policy_{i}": f"ET + CQL (paper): strong_penalty_{i}" for i in range(6)}


def overlapping(texts: list[Text]) -> list[tuple[str, str]]:
    boxes = [(text.get_text(), text.get_window_extent()) for text in texts if text.get_text()]
    return [(a, b) for (a, one), (b, two) in combinations(boxes, 2) if one.overlaps(two)]


@pytest.mark.parametrize("count", [3, 6])
def test_labels_of_many_policies_do_not_overlap(count: int, figures: list[Figure], tmp_path: Path) -> None:
    labels = dict(list(LONG.items())[:count])
    episodes = {name: 1000.0 + np.arange(4.0) for name in labels}
    scores.score_strip({"recorded": np.ones(3), "imagined": np.ones(3)}, episodes, tmp_path / "s.png", labels=labels)
    (figure,) = figures
    axis = figure.axes[0]
    assert len(axis.get_xticklabels()) == count + 2
    assert overlapping([*axis.get_xticklabels(), *axis.texts, axis.title]) == []


def test_a_policy_may_be_called_as_the_data_is(tmp_path: Path) -> None:
    scores.score_strip({"data": np.zeros(2)}, {"data": np.ones(3)}, tmp_path / "s.png")
    table = pd.read_csv(tmp_path / "s.csv")
    assert list(zip(table["kind"], table["score"], strict=True)) == [("reference", 0.0)] * 2 + [("policy", 1.0)] * 3


@pytest.mark.parametrize("panels", [1, 3, 7, 8])
def test_curves_have_a_legend_within_the_picture_in_the_order_of_the_policies(
    panels: int, figures: list[Figure], tmp_path: Path
) -> None:
    one = {"step": [0, 1], **{f"train/quantity_{i}": [1.0, 2.0] for i in range(panels)}}
    runs = {name: pd.DataFrame(one) for name in LONG} | {"policy_0": CLONE_CURVES}  # the first lacks the first panels
    learning.learning_curves(runs, tmp_path / "c.png", title="Policies", labels=LONG)
    (figure,) = figures
    empty = [axis for axis in figure.axes if not axis.axison]
    assert len(empty) <= 2
    (legend,) = [axis.get_legend() for axis in empty[:1]] or figure.legends
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == list(LONG.values())
    box, whole = legend.get_window_extent(), figure.bbox
    assert whole.x0 <= box.x0 and box.x1 <= whole.x1


def test_policies_keep_their_colour_from_figure_to_figure(figures: list[Figure], tmp_path: Path) -> None:
    learning.learning_curves(dict.fromkeys(LONG, POLICY_CURVES), tmp_path / "c.png", title="", labels=LONG)
    scores.score_strip({"data": np.zeros(1)}, {name: np.ones(1) for name in LONG}, tmp_path / "s.png", labels=LONG)
    curves, strip = figures
    lines = [to_hex(line.get_color()) for line in curves.axes[0].get_lines()]
    faces = [np.asarray(found.get_facecolor()) for found in strip.axes[0].collections]
    dots = [np.round(255 * face[0, :3]).tolist() for face in faces if len(face)]  # error bars have no face
    assert dots[1:] == [np.round(255 * np.array(to_rgb(line))).tolist() for line in lines] and len(set(lines)) == len(
        LONG
    )


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
