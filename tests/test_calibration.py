"""`envtf calibrate` from end to end: tiny models of a real robot, numbers, table and figure, and what is kept."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from envtf_lit.errors import UserError
from envtf_lit.studies import suite
from envtf_lit.studies.calibration import CONTRASTS, CalibrationOptions, CalibrationStudy
from envtf_lit.studies.study import run_study
from envtf_lit.studies.suite import MODELS, SuiteOptions, add_model, build_suite
from envtf_lit.world_models.options import EnsembleOptions

ENSEMBLE = EnsembleOptions(
    members=3, elites=2, hidden=(8,), weight_decay=(0.0, 0.0), updates=4, updates_per_epoch=2, batch_size=8
)
TINY = SuiteOptions(transitions=3_000, updates=2, ensemble=ENSEMBLE, threads=1)
FEW = CalibrationOptions(points=50, out_of_distribution_rows=500, episodes=2, rollouts=5, rollout_steps=3)


NAMES = ("coverage_50", "coverage_90", "rank_correlation", *(f"auroc_{name}" for name in CONTRASTS))


def as_drawn(table: pd.DataFrame, numbers: dict[str, float]) -> None:
    """Holds a model's numbers against its curves."""
    panels = {str(name): columns.dropna(axis=1) for name, columns in table.groupby("panel")}
    observed = panels["coverage"].set_index("nominal")["observed"]
    assert observed.is_monotonic_increasing and observed.iloc[-1] > observed.iloc[0]
    assert observed[[0.5, 0.9]].tolist() == pytest.approx([numbers["coverage_50"], numbers["coverage_90"]])
    for name in CONTRASTS:
        roc = panels[f"roc_{name}"]
        assert numbers[f"auroc_{name}"] == pytest.approx(np.trapezoid(roc["true"], roc["false"]), abs=0.02)
    steps = panels["errors"]  # so few that each is a part of its own
    ranks = np.corrcoef([steps[name].rank().to_numpy() for name in ("uncertainty", "median")])
    assert numbers["rank_correlation"] == pytest.approx(ranks[0, 1])


@pytest.mark.usefixtures("small_models")
@pytest.mark.filterwarnings("ignore:.*treespec, LeafSpec:FutureWarning")
def test_models_are_measured_once_and_drawn(tmp_path: Path) -> None:
    lines = list[str]()
    facts: dict[str, Any] = dict(robots=["hopper"], tier="medium", work=tmp_path, options=TINY, progress=False)
    run = lambda out, **more: run_study(  # noqa: E731
        CalibrationStudy(FEW), tmp_path / out, report=lines.append, **facts, **more
    )
    numbers = run("out/calibration.json")
    assert json.loads((tmp_path / "out/calibration.json").read_text()) == numbers
    table = pd.read_csv(tmp_path / "out/calibration.csv")
    for model in MODELS:
        as_drawn(table.query("model == @model"), {name: numbers[f"hopper.{model}.{name}"] for name in NAMES})
        assert 0.0 <= numbers[f"hopper.{model}.clipped"] < 1.0
        assert numbers[f"hopper.{model}.crps"] > 0.0 and f"hopper.{model}.nll" in numbers
    assert numbers["hopper.coverage_90"] == numbers["hopper.transformer.coverage_90"]
    assert lines[1].startswith("hopper: transformer: 50 % intervals hold ")
    with Image.open(tmp_path / "out/calibration.png") as figure:
        assert figure.size[0] > 1_200
    assert set(table["panel"]) == {"coverage", "errors", *(f"roc_{name}" for name in CONTRASTS)}
    assert (tmp_path / "out/calibration.md").read_text().count("| hopper |") == len(MODELS)

    kept = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("calibration-*.json")}
    assert len(kept) == len(MODELS)
    plain, made = suite.model_options("transformer", TINY), build_suite("hopper-medium", tmp_path, TINY, progress=False)
    add_model(made, "certain", replace(plain, epistemic="none"), progress=False)
    again = run("again.json", others={"certain": str(tmp_path / "{task}/models/certain")})
    assert numbers.items() <= again.items()  # the seconds, too: nothing was measured again
    assert kept == {path: path.stat().st_mtime_ns for path in kept}
    found = {key.split(".")[2] for key in again if key.startswith("hopper.certain.")}
    assert found & set(NAMES) == {"coverage_50", "coverage_90", "rank_correlation"}  # novelty it has none
    assert "| hopper | certain |" in (tmp_path / "again.md").read_text()
    assert "certain" in set(pd.read_csv(tmp_path / "again.csv")["model"])


def test_unknown_names_are_refused_before_any_work(tmp_path: Path) -> None:
    facts: dict[str, Any] = dict(robots=["hopper"], work=tmp_path, options=TINY)
    with pytest.raises(UserError, match="hopper-meduim"):
        run_study(CalibrationStudy(), tmp_path / "c.json", tier="meduim", **facts)
    with pytest.raises(UserError, match="no/hopper is not a model folder"):
        run_study(CalibrationStudy(), tmp_path / "c.json", tier="medium", others={"mine": "no/{robot}"}, **facts)
    assert list(tmp_path.iterdir()) == []
