"""`envtf hidden` from end to end: data of hidden robots, three models, errors on draws that none has seen."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from envtf_lit.errors import UserError
from envtf_lit.studies import memory, study
from envtf_lit.studies.memory import HiddenOptions, MemoryStudy
from envtf_lit.studies.study import run_study
from envtf_lit.studies.suite import MODELS, Suite, SuiteOptions, build_suite
from envtf_lit.world_models.options import EnsembleOptions

ENSEMBLE = EnsembleOptions(
    members=2, elites=1, hidden=(8,), weight_decay=(0.0, 0.0), updates=2, updates_per_epoch=2, batch_size=8
)
TINY = SuiteOptions(transitions=1_000, updates=2, context=20, ensemble=ENSEMBLE, threads=1)


@pytest.mark.slow
def test_models_are_measured_on_draws_that_none_has_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = list[str]()
    facts: dict[str, Any] = dict(tier="medium", work=tmp_path, options=TINY, progress=False, report=lines.append)
    hidden = MemoryStudy(HiddenOptions(1_000, 20))
    metrics = run_study(hidden, tmp_path / "out/hidden.json", robots=["hopper"], **facts)
    assert json.loads((tmp_path / "out/hidden.json").read_text()) == metrics
    for name in MODELS:
        assert len(metrics[f"hopper.{name}.one_step_by_context"]) == 32
        assert metrics[f"hopper.{name}.one_step"] == metrics[f"hopper.{name}.one_step_by_context"][16]
        assert metrics[f"hopper.{name}.train_seconds"] > 0 and metrics[f"hopper.{name}.updates"] == 2
        assert any(line.startswith(f"hopper: {name}: nmse ") for line in lines)
    assert metrics["hopper.transformer.one_step_vs_ensemble"] == pytest.approx(
        metrics["hopper.transformer.one_step"] / metrics["hopper.ensemble.one_step"]
    )
    assert metrics["suite.ensemble.members"] == 2 and metrics["suite.ensemble.hidden"] == [8]
    assert metrics["measured.stretches"] == 20 and metrics["suite.precision"] in ("fp32", "bf16")
    assert metrics["machine.cores"] > 0 and "machine.device" in metrics
    with Image.open(tmp_path / "out/hidden.png") as figure:
        assert figure.size[0] > 800
    assert len(pd.read_csv(tmp_path / "out/hidden.csv")) == 3 * (32 + 25)

    data = tmp_path / "hopper-medium-hidden/data"
    (unseen,) = data.glob("unseen-*.h5")
    with h5py.File(data / "dataset.h5") as seen, h5py.File(unseen) as new:
        starts = [np.asarray(file["observations"])[0] for file in (seen, new)]
    assert not np.array_equal(*starts)
    made = unseen.stat().st_mtime_ns
    monkeypatch.setattr(memory, "in_context_error", None)  # nothing is measured again
    again = run_study(hidden, tmp_path / "again.json", robots=["hopper"], **facts)
    assert again == metrics and unseen.stat().st_mtime_ns == made

    def build(task: str, *arguments: Any, **options: Any) -> Suite:
        if task != "hopper-medium-hidden":
            raise KeyboardInterrupt
        return build_suite(task, *arguments, **options)

    monkeypatch.setattr(study, "build_suite", build)
    with pytest.raises(KeyboardInterrupt):
        run_study(hidden, tmp_path / "part.json", robots=["hopper", "walker2d"], **facts)
    assert json.loads((tmp_path / "part.json").read_text()) == metrics and (tmp_path / "part.png").exists()


def test_what_cannot_be_measured_is_refused_before_any_work(tmp_path: Path) -> None:
    facts: dict[str, Any] = dict(robots=["halfcheetah"], work=tmp_path, options=TINY)
    with pytest.raises(UserError, match="halfcheetah-meduim-hidden"):
        run_study(MemoryStudy(), tmp_path / "hidden.json", tier="meduim", **facts)
    with pytest.raises(UserError, match="1 transitions are too few"):
        run_study(MemoryStudy(HiddenOptions(1)), tmp_path / "hidden.json", tier="medium-replay", **facts)
    assert list(tmp_path.iterdir()) == []
