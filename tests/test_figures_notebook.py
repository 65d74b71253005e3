"""Notebooks are executed by this very Python, refuse unknown parameters, and leave nothing behind when they fail."""

import json
import sys
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

from envtf_lit.errors import UserError
from envtf_lit.figures import notebook
from envtf_lit.figures.notebook import execute

KERNEL = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}


def write_notebook(path: Path, code: str, metadata: dict[str, Any] = KERNEL) -> Path:
    parameters = new_code_cell("number: int = 1  # to print", metadata={"tags": ["parameters"]})
    cells = [new_markdown_cell("# Title"), parameters, new_code_cell(code)]
    path.write_text(nbformat.writes(new_notebook(cells=cells, metadata=metadata)))
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


@pytest.mark.parametrize(
    "metadata",
    [{}, {"kernelspec": {"name": "ir", "display_name": "R", "language": "R"}, "language_info": {"name": "R"}}],
)
def test_this_very_python_runs_it_whatever_kernel_is_named_or_found(
    metadata: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    broken = tmp_path / "jupyter/kernels/python3/kernel.json"
    broken.parent.mkdir(parents=True)
    broken.write_text(json.dumps({"argv": ["/bin/false"], "display_name": "Python 3", "language": "python"}))
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path / "jupyter"))
    source = write_notebook(tmp_path / "a.ipynb", "import sys; print(sys.executable, number)", metadata)
    execute(source, tmp_path / "b.ipynb", {"number": 7})
    assert nbformat.read(tmp_path / "b.ipynb", 4).cells[-1].outputs[0].text.split() == [sys.executable, "7"]


def test_a_missing_kernel_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(notebook, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="ipykernel is missing: pip install ipykernel"):
        execute(write_notebook(tmp_path / "a.ipynb", "print(number)"), tmp_path / "b.ipynb", {})


def test_a_damaged_notebook_is_refused(tmp_path: Path):
    (tmp_path / "a.ipynb").write_text("{")
    with pytest.raises(UserError, match=r"a\.ipynb is not a notebook"):
        execute(tmp_path / "a.ipynb", tmp_path / "b.ipynb", {})
