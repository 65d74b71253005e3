"""The report: what it says of a run, whichever way that went, and the two notebooks that say it."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import nbformat
import numpy as np
import papermill
import pytest
from made_up_runs import made_up_run, said

from envtf_lit.errors import UserError
from envtf_lit.evaluation.comparison import compare
from envtf_lit.figures import sentences
from envtf_lit.figures.notebook import execute
from envtf_lit.figures.report import Run, project_root, read_run
from envtf_lit.pipeline.yaml import load_params, params_yaml, preset_params

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
REPORTS = ("report.ipynb", "report_offline.ipynb")


@pytest.fixture(scope="module")
def lost(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run whose last policy does worse than those from data alone."""
    return read_run(made_up_run(tmp_path_factory.mktemp("lost")), simulator=True)


@pytest.fixture(scope="module")
def offline(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return read_run(made_up_run(tmp_path_factory.mktemp("offline"), simulator=False), simulator=False)


def reordered(run: Run, *names: str) -> Run:
    """The run with these of its policies alone, in this order."""
    policies = {name: run.policies[name] for name in names}
    return replace(run, metrics=run.metrics | {"policies": policies})


# comparisons


def test_a_difference_counts_beyond_twice_its_standard_error_and_the_least():
    found = compare(np.array([3.0, 5.0, 4.0]), np.array([1.0, 1.0, 1.0]))
    assert (found.gain, found.starts, found.verdict) == (3.0, 3, "better")
    assert found.standard_error == pytest.approx(1 / np.sqrt(3))
    assert compare(np.array([1.0, 1.0]), np.array([3.0, 4.0])).verdict == "worse"
    assert compare(np.array([0.0, 4.0]), np.array([1.0, 1.0])).verdict == "not clearly different"
    assert compare(np.array([3.0, 5.0, 4.0]), np.ones(3), least=3.5).verdict == "not clearly different"


def test_one_start_alone_tells_nothing():
    found = compare(np.array([9.0]), np.array([1.0]))
    assert found.standard_error == np.inf and found.verdict == "not clearly different"


# sentences


def test_a_result_against_us_is_printed_as_such(lost: Run):
    assert "not above BC, CQL" in sentences.about_scores(lost)
    assert "Imagination **hurt**: -21.5 points for ET + CQL against CQL" in sentences.about_imagination(lost)
    assert "it **hurt**: -21.5 points" in sentences.as_experience(lost)
    assert "-6.1 to BC, -21.5 to CQL" in sentences.as_policy(lost)
    assert list(sentences.comparison_table(lost)["verdict"]) == ["worse", "worse"]


def test_a_result_in_our_favour_is_printed_as_such(lost: Run):
    won = replace(lost, episodes=lost.episodes | {"dreamer": lost.episodes["plain"] + np.array([4.0, 5.0, 6.0])})
    assert "Imagination helped: +5.0 points" in sentences.about_imagination(won)
    assert list(sentences.comparison_table(won)["verdict"]) == ["better", "better"]


def test_the_report_is_about_the_last_policy_whatever_its_name(lost: Run):
    turned = reordered(lost, "dreamer", "clone", "plain")
    assert "CQL scores **28.3**. That is above the data's mean, ET + CQL, BC." in sentences.about_scores(turned)
    assert list(sentences.comparison_table(turned)["CQL against"]) == ["ET + CQL", "BC"]
    assert "Imagination **hurt**: -21.5 points for ET + CQL against CQL" in sentences.about_imagination(turned)


@pytest.mark.parametrize("names", [("clone", "plain"), ("dreamer",)])
def test_imagination_is_not_judged_without_both_kinds_of_policy(lost: Run, names: tuple[str, ...]):
    partial = reordered(lost, *names)
    assert "is not seen here" in sentences.about_imagination(partial)
    assert sentences.as_experience(partial) == ""
    assert len(sentences.comparison_table(partial)) == len(names) - 1
    assert "**" in sentences.as_policy(partial)


def test_minaris_data_have_returns_in_place_of_scores(tmp_path: Path):
    run = read_run(made_up_run(tmp_path, "minari"), simulator=True)
    assert run.unit == run.measure == "return"
    assert "ET + CQL returns **201.0**" in sentences.about_scores(run)
    assert "Imagination **hurt**: -700.0 of return" in sentences.about_imagination(run)
    assert "point" not in sentences.about_imagination(run)
    assert sentences.about_origin(run) == "A note."


def test_estimates_are_never_called_scores(offline: Run):
    text = " ".join(
        [sentences.about_estimates(offline), sentences.about_imagination(offline), sentences.as_policy(offline)]
    )
    assert "errs by 10 per episode" in text and "CQL, BC" not in text
    assert "by more than that error? BC, CQL." in text
    assert "Imagination **hurt**: -700.0 of imagined return" in text
    assert "the one that the policy was trained in" in text and "Only the robot can tell" in text
    assert "score" not in text and "promise" not in text
    assert "finds 50% of the terminations" in sentences.about_termination(offline)
    table = sentences.estimates_table(offline)
    assert list(table["known by"]) == ["record", *["imagination"] * 4]
    assert list(table["learned from"])[2:] == ["data", "data", "data, and rollouts in small"]
    assert list(table["effective episodes"]) == ["", "", "", "20.0", "7.8"]


def test_beside_each_score_stands_how_many_episodes_it_was_learned_from(lost: Run):
    assert list(sentences.scores_table(lost)["effective episodes"]) == ["", "", "20.0", "7.8"]
    older = {
        name: {k: v for k, v in found.items() if k != "effective_episodes"} for name, found in lost.policies.items()
    }
    before = replace(lost, metrics=lost.metrics | {"policies": older})
    assert list(sentences.scores_table(before)["effective episodes"]) == [""] * 4


def test_critics_are_spoken_of_where_there_are_any(lost: Run):
    assert sentences.about_q(lost) == "At the end the mean Q of the batch is 3 for CQL, 3 for ET + CQL."
    assert "no Q" in sentences.about_q(reordered(lost, "clone"))


# reading


def test_a_run_is_found_from_the_notebooks_folder(tmp_path: Path):
    root = made_up_run(tmp_path / "project")
    (root / "notebooks").mkdir()
    (root / "reports/metrics.json").rename(root / "reports/kept.json")
    (root / "dvc.yaml").touch()
    (root / "reports/kept.json").rename(root / "reports/metrics.json")
    assert read_run(root / "notebooks", simulator=True).root == root
    (tmp_path / "elsewhere").mkdir()
    with pytest.raises(UserError, match=r"a folder above it has a dvc\.yaml"):
        project_root(tmp_path / "elsewhere")


def test_a_run_of_the_other_kind_names_its_notebook(offline: Run, lost: Run):
    with pytest.raises(UserError, match=r"task of this run is None, whose report is notebooks/report_offline\.ipynb"):
        read_run(offline.root, simulator=True)
    with pytest.raises(UserError, match=r"is hopper-medium-replay, whose report is notebooks/report\.ipynb"):
        read_run(lost.root, simulator=False)


def test_plots_of_another_run_are_refused(tmp_path: Path):
    root = made_up_run(tmp_path)
    metrics = json.loads((root / "reports/metrics.json").read_text())
    metrics["policies"]["dreamer"]["score_mean"] += 0.1
    (root / "reports/metrics.json").write_text(json.dumps(metrics))
    with pytest.raises(UserError, match="are of different runs: run `dvc repro`"):
        read_run(root, simulator=True)


# the notebooks


@pytest.mark.parametrize("name", REPORTS)
def test_a_report_names_its_parameters_and_is_stripped(name: str):
    parameters = papermill.inspect_notebook(str(NOTEBOOKS / name))
    assert list(parameters) == ["root"]
    assert parameters["root"]["help"]
    program = shutil.which("nbstripout", path=str(Path(sys.executable).parent))
    assert program is not None
    assert (
        subprocess.run([program, "--verify", str(NOTEBOOKS / name)], capture_output=True, check=False).returncode == 0
    )


@pytest.mark.parametrize("name", REPORTS)
def test_text_and_code_take_turns(name: str):
    kinds = [cell.cell_type for cell in nbformat.read(NOTEBOOKS / name, 4).cells]
    assert kinds == ["markdown", "code"] * (len(kinds) // 2) + ["markdown"] * (len(kinds) % 2)


def test_the_report_has_the_same_bytes_every_time_and_needs_no_network(lost: Run):
    written = []
    for _ in range(2):
        page = execute(NOTEBOOKS / "report.ipynb", lost.root / "reports/report.ipynb", {"root": "."}, cwd=lost.root)
        written.append((page.read_bytes(), page.with_suffix(".ipynb").read_bytes()))
    assert written[0] == written[1]
    html, text = page.read_text(), said(page.with_suffix(".ipynb"))
    assert re.findall(r"<script|<link|@import|url\(['\"]?http|src=\"(?!data:)", html) == []
    assert str(lost.root) not in html
    assert "ET + CQL scores **6.8**" in text and "A note." in text
    assert "promised **390 to 450**" in text
    assert html.count('src="data:image/png') == 10 and html.count('src="data:image/gif') == 1
    assert "No description" not in html


def test_the_report_without_a_simulator(offline: Run):
    source, output = NOTEBOOKS / "report_offline.ipynb", offline.root / "reports/report.ipynb"
    beside = offline.root / "notebooks"  # where JupyterLab starts the kernel
    beside.mkdir()
    page = execute(source, output, {}, cwd=beside)
    text = said(output)
    assert "No video" in text and "a classifier learned from the log says so" in text
    assert "D4RL" not in text and "score" not in text
    first, rest = text.split("transitions in", 1)  # before a word is said of the data
    assert "**Try first ET + CQL**" in first and "ET + CQL **acts beyond the log**" in first
    assert "promised **390 to 450**" in rest
    assert page.read_text().count('src="data:image/png') == 10


# what it suggests to try


def suggestions(name: str) -> list[str]:
    """The `section.key: value` of its last cell."""
    text = nbformat.read(NOTEBOOKS / name, 4).cells[-1].source
    return re.findall(r"^\d+\. `([\w.]+: [^`]+)`", text, re.MULTILINE)


@pytest.mark.parametrize("name", REPORTS)
@pytest.mark.parametrize("preset", [None, "tiny"])
def test_every_suggestion_changes_the_run_and_is_allowed(name: str, preset: str | None, tmp_path: Path):
    path = NOTEBOOKS.parent / "params.yaml"
    if preset is not None:
        path = tmp_path / "params.yaml"
        path.write_text(params_yaml(preset_params(preset)))
    assert len(suggestions(name)) == 5
    for suggestion in suggestions(name):
        key, _, value = suggestion.partition(": ")
        assert load_params(path, [f"{key}={value}"]) != load_params(path), suggestion
