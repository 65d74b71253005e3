"""The pictures that only tutorials show: drawn whole, with the numbers behind them."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from envtf_lit.evaluation.in_context import Doubt
from envtf_lit.figures.frontier import frontiers
from envtf_lit.figures.in_context import bodies_apart, change_curves, doubt_curves
from envtf_lit.figures.pendulum import paths_in_worlds, swings, value_maps

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
    assert table(path)["time"].max() == pytest.approx(39 * 0.05)
    assert len(colours(path)) > 50


def test_a_line_breaks_where_the_pendulum_passes_the_bottom(tmp_path: Path) -> None:
    turning = (np.linspace(0, 4 * np.pi, 60) + np.pi) % (2 * np.pi) - np.pi
    straight = swings({"a": turning}, tmp_path / "a.png", title="", step=0.05)
    assert table(straight)["angle"].notna().all()  # the numbers have no gaps


def test_two_worlds_are_drawn_in_a_panel_for_each_plan(tmp_path: Path) -> None:
    found = {"true": np.stack([ANGLE, ANGLE]), "learned": np.stack([ANGLE + 0.1, ANGLE])}
    path = paths_in_worlds(found, tmp_path / "paths.png", step=0.05, title="Two worlds")
    assert len(table(path)) == 2 * 2 * 40
    values = {"true": np.arange(12.0).reshape(4, 3), "learned": np.zeros((4, 3))}
    maps = value_maps(values, (-np.pi, -8.0), (np.pi, 8.0), tmp_path / "values.png", title="Worth")
    assert len(table(maps)) == 24 and len(colours(maps)) > 50


def test_a_frontier_rings_who_was_published(tmp_path: Path) -> None:
    rows = dict(update=[0, 1], excess=[0.0, 0.1], promise=[10.0, 20.0], error=[1.0, 2.0], lost=[0.0, 0.0], kept=[0, 1])
    found = {"default": pd.DataFrame(rows), "bold": pd.DataFrame(rows)}
    promised = colours(frontiers(found, tmp_path / "promised.png"))
    path = frontiers(found, tmp_path / "true.png", truths={"bold": np.array([5.0, 7.0])})
    assert table(path)["run"].tolist() == ["default"] * 2 + ["bold"] * 2
    truth = rgb("#0072B2")
    assert truth in colours(path) and truth not in promised
