"""Notebooks, executed by papermill in this very Python and rendered as one HTML file that needs no network."""

import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import nbformat
import papermill
from jinja2 import DictLoader
from jupyter_client.kernelspec import KernelSpec
from jupyter_client.manager import AsyncKernelManager
from nbconvert import HTMLExporter
from papermill.exceptions import PapermillExecutionError

from envtf_lit.errors import UserError, did_you_mean
from envtf_lit.files import replacing

# JupyterLab's page without the scripts that it would fetch: MathJax, Mermaid, RequireJS
OFFLINE = """
{%- extends 'lab/index.html.j2' -%}
{%- block html_head_js -%}{%- endblock html_head_js -%}
{%- block html_head_js_mathjax -%}{%- endblock html_head_js_mathjax -%}
{%- block html_head_js_mermaidjs -%}{%- endblock html_head_js_mermaidjs -%}
"""
# the same with the code folded away
FOLDED = f"""{OFFLINE}
{{%- block input_group -%}}
<details style="margin-left: 64px; color: gray"><summary>code</summary>{{{{ super() }}}}</details>
{{%- endblock input_group -%}}
"""
START = 300  # seconds that a kernel may take to begin: more than a minute on a busy machine
KERNEL = {"name": "python3", "display_name": "Python 3", "language": "python"}


class OwnKernel(AsyncKernelManager):
    """A kernel of this very Python, whatever kernels Jupyter finds on the machine by that name."""

    @property
    def kernel_spec(self) -> KernelSpec:
        """How to start it."""
        argv = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
        return KernelSpec(argv=argv, display_name=KERNEL["display_name"], language=KERNEL["language"])


def execute(
    notebook: Path,
    output: Path,
    parameters: Mapping[str, Any],
    *,
    cwd: Path | str = ".",
    folded: bool = True,
    progress: bool = False,
) -> Path:
    """Runs a notebook in this Python's own kernel and writes it with its outputs, as notebook and as HTML.

    Whatever kernel the notebook names, or none, makes no difference. Timestamps, durations and random names are left
    out, so that equal outputs give equal bytes.

    Args:
        notebook: the source, with one cell tagged `parameters`.
        output: the executed `.ipynb` to write; the HTML goes beside it.
        parameters: values for names in the parameters cell.
        cwd: the folder to run in.
        folded: the HTML hides the code until it is asked for, as a report's; a tutorial's is there to be read.
        progress: whether to show a bar.

    Returns:
        The HTML's path.

    Raises:
        UserError: the notebook is missing or damaged, has no parameter of a given name, a cell failed, or ipykernel is
            not installed. Nothing is written then.
    """
    if find_spec("ipykernel") is None:
        raise UserError("Notebooks run in a kernel of this Python, and ipykernel is missing: pip install ipykernel.")
    source = _read(notebook, parameters)
    try:
        executed = papermill.execute_notebook(
            source,
            None,
            dict(parameters),
            kernel_name=KERNEL["name"],
            kernel_manager_class=OwnKernel,
            progress_bar=progress,
            cwd=str(cwd),
            start_timeout=START,
            extra_arguments=["--IPKernelApp.log_level=ERROR"],  # it warns of its own loopback connection
        )
    except PapermillExecutionError as error:
        raise UserError(
            f"{notebook} failed in cell {error.cell_index}: {error.ename}: {error.evalue}; run the stages before it, "
            "or open the notebook to see where it goes wrong."
        ) from error
    _forget_the_run(executed)
    page = output.with_suffix(".html")
    with replacing(output) as temporary, replacing(page) as html:
        temporary.write_text(nbformat.writes(executed), encoding="utf-8")
        html.write_text(_to_html(executed, notebook.stem, FOLDED if folded else OFFLINE), encoding="utf-8")
    return page


def _read(notebook: Path, parameters: Mapping[str, Any]) -> nbformat.NotebookNode:
    """The notebook with a kernel named in it; papermill only warns of a parameter that it does not have."""
    if not notebook.is_file():
        raise UserError(f"{notebook} does not exist: check the path.")
    try:
        source = nbformat.read(notebook, as_version=4)
    except (nbformat.reader.NotJSONError, nbformat.ValidationError, UnicodeDecodeError) as error:
        raise UserError(f"{notebook} is not a notebook ({str(error)[:80]}): write it anew.") from None
    source.metadata = nbformat.from_dict({"kernelspec": KERNEL})
    known = papermill.inspect_notebook(source)
    for name in parameters:
        if name not in known:
            hint = did_you_mean(name, known) if known else "it has no cell tagged `parameters`"
            raise UserError(f"{notebook} has no parameter {name!r}: {hint}")
    return source


def _forget_the_run(executed: nbformat.NotebookNode) -> None:
    executed.metadata.pop("papermill", None)
    for place, cell in enumerate(executed.cells):
        cell.id = str(place)  # the cell of papermill's parameters has a random one
        cell.metadata.pop("papermill", None)
        cell.metadata.pop("execution", None)


def _to_html(executed: nbformat.NotebookNode, title: str, template: str) -> str:
    exporter = HTMLExporter(template_file="page.html.j2", extra_loaders=[DictLoader({"page.html.j2": template})])
    html, _ = exporter.from_notebook_node(executed, resources={"metadata": {"name": title}})
    return html
