"""The fine-tuning study: what is read from the curves, and what is asked of `envtf model fit`."""

import subprocess
from pathlib import Path

import pytest

from envtf_lit.errors import UserError
from envtf_lit.studies import finetune
from envtf_lit.studies.finetune import FinetuneOptions, compare_curves, run_finetune

SCRATCH, SHORT = {100: 0.4, 200: 0.2, 300: 0.25}, {100: 0.5}


def test_updates_are_counted_until_the_best_error_from_scratch_is_reached() -> None:
    found = compare_curves(SCRATCH, SHORT, {25: 0.3, 50: 0.2, 75: 0.1})
    assert found["scratch_error"] == 0.2 and found["scratch_updates"] == 200
    assert found["tuned_updates_to_scratch_error"] == 50 and found["share_of_updates"] == 0.25
    assert found["tuned_error"] == 0.1 and found["short_scratch_error"] == 0.5
    never = compare_curves(SCRATCH, SHORT, {25: 0.3})
    assert never["tuned_updates_to_scratch_error"] is None and never["share_of_updates"] is None


def test_each_model_is_trained_once_and_the_last_from_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = list[dict[str, str]]()

    def fit(command: list[str], *, check: bool) -> None:
        flags = dict(word.removeprefix("--").split("=", 1) for word in command[5:])
        runs.append(flags)
        log = Path(flags["trainer.logger.save_dir"]) / "log/version_0"
        (log / "published").mkdir(parents=True)
        (log / "metrics.csv").write_text("step,val/open_loop_error\n0,\n4,0.5\n9,0.25\n")

    monkeypatch.setattr(subprocess, "run", fit)
    monkeypatch.setattr(finetune, "_dataset", lambda task, rows, work, options: work / f"{task}-{rows}.h5")
    options = FinetuneOptions(base_updates=8, updates=40, freeze="[blocks, norm]")
    out, work = tmp_path / "out.json", tmp_path / "work"
    result = run_finetune(out, work=work, options=options)
    assert [run["model.options.updates"] for run in runs] == ["8", "40", "10", "10"]
    assert [run["data.path"].endswith("hidden-20000.h5") for run in runs] == [False, True, True, True]
    base = str(work / "seed-0/base-8/published")
    assert [run.get("model.init_from") for run in runs] == [None, None, None, base]
    assert runs[3]["model.freeze"] == "[blocks, norm]" and (work / "seed-0/tuned-10-0.001-blocks-norm").is_dir()
    assert result["scratch_curve"] == {5: 0.5, 10: 0.25} and result["base_updates"] == 8 and "torch" in result
    assert run_finetune(out, work=work, options=options).keys() == result.keys() and len(runs) == 4
    (tmp_path / "mine.json").write_text("{}")
    with pytest.raises(UserError, match=r"mine\.json would be replaced"):
        run_finetune(tmp_path / "mine.json", work=work, options=options)
