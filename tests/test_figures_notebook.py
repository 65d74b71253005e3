"""Notebooks are executed by this very Python, refuse unknown parameters, and leave nothing behind when they fail."""

import shutil
import subprocess
import sys
from pathlib import Path

import nbformat
import numpy as np
import papermill
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook
from reports import said

from envtf_lit.errors import UserError
from envtf_lit.figures.notebook import execute

REPORT = Path(__file__).parents[1] / "notebooks/report.ipynb"


def write_notebook(path: Path, code: str) -> Path:
    parameters = new_code_cell("number: int = 1  # to print", metadata={"tags": ["parameters"]})
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    cells = [new_markdown_cell("# Title"), parameters, new_code_cell(code)]
    path.write_text(nbformat.writes(new_notebook(cells=cells, metadata=kernel)))
    return path


def test_a_notebook_runs_here_with_its_parameters(tmp_path):
    code = "import sys; from pathlib import Path; print(sys.executable, number, Path('here').read_text())"
    (tmp_path / "work").mkdir()
    (tmp_path / "work/here").write_text("found")
    source = write_notebook(tmp_path / "a.ipynb", code)
    page = execute(source, tmp_path / "out/b.ipynb", {"number": 7}, cwd=tmp_path / "work")
    executed = nbformat.read(tmp_path / "out/b.ipynb", 4)
    assert executed.cells[-1].outputs[0].text.split() == [sys.executable, "7", "found"]
    html = page.read_text()
    assert "<details" in html
    assert "found" in html
    assert str(tmp_path) not in (tmp_path / "out/b.ipynb").read_text()
    assert sorted(path.name for path in page.parent.iterdir()) == ["b.html", "b.ipynb"]


def test_unknown_parameters_are_refused(tmp_path):
    source = write_notebook(tmp_path / "a.ipynb", "print(number)")
    with pytest.raises(UserError, match="has no parameter 'numbre': did you mean 'number'"):
        execute(source, tmp_path / "b.ipynb", {"numbre": 7})
    with pytest.raises(UserError, match=r"missing\.ipynb does not exist"):
        execute(tmp_path / "missing.ipynb", tmp_path / "b.ipynb", {})
    assert [path.name for path in tmp_path.iterdir()] == ["a.ipynb"]


def test_a_failing_cell_leaves_nothing_behind(tmp_path):
    source = write_notebook(tmp_path / "a.ipynb", "raise RuntimeError('no such luck')")
    with pytest.raises(UserError, match="RuntimeError: no such luck"):
        execute(source, tmp_path / "b.ipynb", {})
    assert [path.name for path in tmp_path.iterdir()] == ["a.ipynb"]


def test_the_report_names_its_parameters_and_is_stripped():
    parameters = papermill.inspect_notebook(str(REPORT))
    assert list(parameters) == ["root"]
    assert parameters["root"]["help"]
    program = shutil.which("nbstripout", path=str(Path(sys.executable).parent))
    assert program is not None
    assert subprocess.run([program, "--verify", str(REPORT)], capture_output=True, check=False).returncode == 0


def lost_experiment(root: Path, source: str) -> Path:
    """What the stages before the report write, for an experiment that went against us; the report on it."""
    import pandas as pd
    from analytic import linear_data, linear_world
    from PIL import Image

    from envtf_lit.data.cards import dataset_card
    from envtf_lit.evaluation.horizon import horizon_report
    from envtf_lit.evaluation.metrics import collect_metrics, world_model_metrics
    from envtf_lit.figures import gallery
    from envtf_lit.figures.video import write_gif
    from envtf_lit.files import write_json
    from envtf_lit.robots.returns import Episode, Returns
    from envtf_lit.robots.tasks import ROBOTS
    from envtf_lit.world_models.forecast import Scale, whole_episodes

    hopper, data = ROBOTS["hopper"], linear_data((40, 50), noise=0.02)
    model_curves = pd.DataFrame({"epoch": [1], "train/loss": [1.0], "val/loss": [1.1], "val/open_loop_error": [0.2]})
    policy_curves = pd.DataFrame({"epoch": [1], "train/q_data": [3.0]})
    for name, curves in (
        ("world_model", model_curves), ("policy/cql", policy_curves), ("policy/et_cql", policy_curves)
    ):  # fmt: skip
        (root / "models" / name).mkdir(parents=True)
        curves.to_csv(root / "models" / name / "curves.csv", index=False)
    episode = Episode(0, np.zeros((2, 3)), np.zeros((1, 1)), np.zeros(1), np.zeros((2, 6)))
    returns = {}
    for name, level in (("bc", 400.0), ("cql", 900.0), ("et_cql", 200.0)):
        values = level + np.arange(3.0)
        scores = np.array([hopper.normalised_score(value) for value in values])
        returns[name] = Returns(returns=values, lengths=np.ones(3), scores=scores, median=episode)
    scale, plots = Scale.of(data), root / "reports/plots"
    report = horizon_report(linear_world(0.02, std=0.02), whole_episodes(data, 1, seed=0), scale)
    gallery.draw_dataset(data, source, plots)
    gallery.draw_world_model(report, scale, hopper, model_curves, plots)
    gallery.draw_rollouts(np.zeros(9, dtype=int), np.linspace(0.1, 1.0, 9), plots)
    gallery.draw_policies(data, source, hopper, returns, {"cql": policy_curves, "et_cql": policy_curves}, plots)
    write_gif([Image.new("RGB", (8, 8))], root / "reports/video/real_vs_imagined.gif")
    metrics = collect_metrics(
        returns, task="hopper-medium-replay", seed=3, dataset=data, source=source, robot=hopper, rollouts=9,
        world_model=world_model_metrics(report, scale, parameters=12),
    )  # fmt: skip
    write_json(root / "reports/metrics.json", metrics)
    write_json(root / "data/dataset.json", dataset_card(data, source, {"path": "my.h5", "note": "A note."}))
    return execute(REPORT, root / "reports/report.ipynb", {"root": "."}, cwd=root)


def test_the_report_prints_a_result_against_us_as_such(tmp_path):
    page = lost_experiment(tmp_path, "file")
    text = said(page.with_suffix(".ipynb"))
    assert "not above the behaviour clone, CQL on data alone" in text
    assert "Imagination **hurt**: -21.5 points" in text
    assert "it **hurt**: -21.5 points" in text
    assert page.stat().st_size > 100_000


def test_the_report_on_minaris_data_speaks_of_returns(tmp_path):
    text = said(lost_experiment(tmp_path, "minari").with_suffix(".ipynb"))
    assert "Scores are D4RL's" not in text and "points" not in text
    assert "with imagination returns **201.0**" in text
    assert "Imagination **hurt**: -700.0 of return" in text
    assert text.count("A note.") == 2  # beside the table, and where the log is said to come from
