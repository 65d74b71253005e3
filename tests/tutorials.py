"""The tutorials as the tests read them: their cells, and the solutions that are hidden in their exercises."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nbformat
from nbformat.v4 import new_code_cell, new_notebook

from envtf_lit.project.tutorials import tutorials

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
NAMES = tutorials(NOTEBOOKS)
SOLUTION = re.compile(r"<details>\s*<summary>(.*?)</summary>(.*?)</details>", re.DOTALL)
CODE = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


def cells(name: str, kind: str | None = None) -> list[Any]:
    """A tutorial's cells, all or those that are `code` or `markdown`."""
    found = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4).cells
    return [cell for cell in found if kind in (None, cell.cell_type)]


def solutions(name: str) -> dict[str, str]:
    """The code of each hidden solution, by its summary."""
    text = "\n\n".join(cell.source for cell in cells(name, "markdown"))
    return {summary: "\n".join(CODE.findall(body)) for summary, body in SOLUTION.findall(text)}


def with_solutions(name: str, folder: Path) -> Path:
    """A copy of a tutorial in which its solutions are run, one after the other, behind all else."""
    answers = [new_code_cell(f"# {summary}\n{code}") for summary, code in solutions(name).items()]
    path = folder / f"{name}.ipynb"
    path.write_text(nbformat.writes(new_notebook(cells=[*cells(name), *answers])), encoding="utf-8")
    return path


def outputs(executed: Path) -> list[Mapping[str, Any]]:
    """All outputs of an executed notebook."""
    found = nbformat.read(executed, as_version=4).cells
    return [output for cell in found if cell.cell_type == "code" for output in cell.outputs]
