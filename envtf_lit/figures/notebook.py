"""Executes a notebook with papermill and renders it as HTML, its code folded away."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nbformat
import papermill
from jinja2 import DictLoader
from jupyter_client.kernelspec import NoSuchKernel
from nbconvert import HTMLExporter
from papermill.exceptions import PapermillExecutionError

from envtf_lit.errors import UserError, did_you_mean
from envtf_lit.files import replacing

FOLDED = """
{%- extends 'lab/index.html.j2' -%}
{%- block input_group -%}
<details style="margin-left: 64px; color: gray"><summary>code</summary>{{ super() }}</details>
{%- endblock input_group -%}
"""


def execute(
    notebook: Path, output: Path, parameters: Mapping[str, Any], *, cwd: Path | str = ".", progress: bool = False
) -> Path:
    """Runs a notebook in this Python's own kernel and writes it with its outputs, as notebook and as HTML.

    The executed notebook holds no timestamps, durations or paths of this machine.

    Args:
        notebook: the source, with one cell tagged `parameters`.
        output: the executed `.ipynb` to write; the HTML goes beside it.
        parameters: values for names in the parameters cell.
        cwd: the folder to run in.
        progress: whether to show a bar.

    Returns:
        The HTML's path.

    Raises:
        UserError: the notebook is missing, has no parameter of a given name, or a cell failed. Nothing is written then.
    """
    _check_parameters(notebook, parameters)
    try:
        executed = papermill.execute_notebook(
            str(notebook),
            None,
            dict(parameters),
            kernel_name="python3",
            progress_bar=progress,
            cwd=str(cwd),
            extra_arguments=["--IPKernelApp.log_level=ERROR"],  # it warns of its own loopback connection
        )
    except PapermillExecutionError as error:
        raise UserError(
            f"{notebook} failed in cell {error.cell_index}: {error.ename}: {error.evalue}; run the stages before it, "
            "or open the notebook to see where it goes wrong."
        ) from error
    except NoSuchKernel:
        raise UserError("Jupyter finds no kernel named python3: install ipykernel into this environment.") from None
    _forget_the_run(executed)
    page = output.with_suffix(".html")
    with replacing(output) as temporary, replacing(page) as html:
        temporary.write_text(nbformat.writes(executed), encoding="utf-8")
        html.write_text(_to_html(executed, notebook.stem), encoding="utf-8")
    return page


def _check_parameters(notebook: Path, parameters: Mapping[str, Any]) -> None:
    """Papermill only warns of a name that the notebook does not have, and goes on with the default."""
    if not notebook.is_file():
        raise UserError(f"{notebook} does not exist: check the path.")
    known = papermill.inspect_notebook(str(notebook))
    for name in parameters:
        if name not in known:
            hint = did_you_mean(name, known) if known else "it has no cell tagged `parameters`"
            raise UserError(f"{notebook} has no parameter {name!r}: {hint}")


def _forget_the_run(executed: nbformat.NotebookNode) -> None:
    executed.metadata.pop("papermill", None)
    for cell in executed.cells:
        cell.metadata.pop("papermill", None)
        cell.metadata.pop("execution", None)


def _to_html(executed: nbformat.NotebookNode, title: str) -> str:
    exporter = HTMLExporter(template_file="folded.html.j2", extra_loaders=[DictLoader({"folded.html.j2": FOLDED})])
    html, _ = exporter.from_notebook_node(executed, resources={"metadata": {"name": title}})
    return html
