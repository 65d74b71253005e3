"""The pictures that only tutorials show: drawn whole, with the numbers behind them."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from analytic import linear_data, linear_world
from PIL import Image

from envtf_lit.evaluation.horizon import horizon_report
from envtf_lit.evaluation.in_context import Doubt
from envtf_lit.figures.in_context import bodies_apart, change_curves, doubt_curves
from envtf_lit.figures.model import traces
from envtf_lit.figures.pendulum import paths_in_worlds, swings, value_maps
from envtf_lit.figures.plane import belief_maps, paths_on_plane
from envtf_lit.world_models.forecast import Scale, whole_episodes

ANGLE = np.linspace(-3.0, 3.0, 40)


def colours(path: Path) -> set[tuple[int, int, int]]:
    """All colours of a picture."""
    with Image.open(path) as picture:
        assert min(picture.size) > 200
        return {colour for _, colour in picture.convert("RGB").getcolors(1 << 24) or []}  # pyright: ignore[reportReturnType]


def rgb(colour: str) -> tuple[int, int, int]:
    """A colour such as #D55E00 in numbers."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def table(path: Path) -> pd.DataFrame:
    return pd.read_csv(path.with_suffix(".csv"))


def test_bodies_and_their_change(tmp_path: Path) -> None:
    apart = bodies_apart({"nominal": np.zeros(6), "weak": np.ones(4)}, "way (m)", tmp_path / "bodies.png")
    assert table(apart).groupby("body")["value"].agg(["size", "mean"]).to_numpy().tolist() == [[6, 0], [4, 1]]
    curves = {name: np.exp(np.random.default_rng(0).normal(size=(3, 9))) for name in ("transformer", "ensemble")}
    change = change_curves(curves, 4, tmp_path / "change.png", begun={"transformer": np.ones((3, 5))})
    assert table(change).query("model == 'ensemble'")["median"].tolist() == pytest.approx(curves["ensemble"][1], 1e-5)
    assert table(change).query("begun == 4")["step"].tolist() == [4, 5, 6, 7, 8]
    assert {rgb("#D55E00"), rgb("#0072B2")} <= colours(change)


def test_doubt_is_a_panel_for_each_model(tmp_path: Path) -> None:
    doubts = {name: Doubt(np.full(5, 0.2), np.full(5, 0.1)) for name in ("transformer", "ensemble")}
    path = doubt_curves(doubts, tmp_path / "doubt.png")
    assert len(table(path)) == 10 and colours(path)
    with Image.open(path) as both, Image.open(doubt_curves({"ensemble": doubts["ensemble"]}, path)) as one:
        assert both.size[0] > 1.5 * one.size[0]


def test_swings_show_every_episode(tmp_path: Path) -> None:
    path = swings({"one": ANGLE, "other": -ANGLE}, tmp_path / "swings.png", title="Two", step=0.05)
    assert table(path).groupby("episode")["angle"].size().tolist() == [40, 40]
    assert max(table(path)["time"]) == pytest.approx(39 * 0.05)
    assert len(colours(path)) > 50


def test_a_line_breaks_where_the_pendulum_passes_the_bottom(tmp_path: Path) -> None:
    turning = (np.linspace(0, 4 * np.pi, 60) + np.pi) % (2 * np.pi) - np.pi
    straight = swings({"a": turning}, tmp_path / "a.png", title="", step=0.05)
    assert bool(table(straight)["angle"].notna().to_numpy().all())  # the numbers have no gaps


def test_two_worlds_are_drawn_in_a_panel_for_each_plan(tmp_path: Path) -> None:
    found = {"true": np.stack([ANGLE, ANGLE]), "learned": np.stack([ANGLE + 0.1, ANGLE])}
    path = paths_in_worlds(found, tmp_path / "paths.png", step=0.05, title="Two worlds")
    assert len(table(path)) == 2 * 2 * 40
    values = {"true": np.arange(12.0).reshape(4, 3), "learned": np.zeros((4, 3))}
    maps = value_maps(values, (-np.pi, -8.0), (np.pi, 8.0), tmp_path / "values.png", title="Worth")
    assert len(table(maps)) == 24 and len(colours(maps)) > 50


def test_the_plane_shows_paths_block_and_beliefs(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    found = {"SAC": rng.uniform(-1, 1, (3, 5, 2)), "CQL": rng.uniform(-1, 1, (2, 5, 2))}
    log = rng.uniform(-1, 1, (50, 2))
    path = paths_on_plane(log, found, tmp_path / "paths.png", goal=(0.8, 0.8), block=0.4, title="Two")
    assert table(path).groupby("who")["episode"].nunique().to_dict() == {"CQL": 2, "SAC": 3}
    assert rgb("#E69F00") in colours(path) and rgb("#0072B2") in colours(path)
    beliefs = {"SAC": np.full((5, 5), 3.0), "CQL": np.linspace(-2, -1, 25).reshape(5, 5)}
    maps = belief_maps(beliefs, log[:3], tmp_path / "maps.png", title="Two")
    assert len(table(maps)) == 50


def test_traces_show_the_reward_where_a_panel_is_free(tmp_path: Path) -> None:
    log = linear_data((40, 50))
    report = horizon_report(linear_world(error=0.05), whole_episodes(log, 2, seed=0), Scale.of(log))
    path = traces(report, None, tmp_path / "traces.png")
    assert list(dict.fromkeys(table(path)["quantity"])) == ["s[0]", "s[1]", "s[2]", "reward"]
