"""The documentation site: `make docs` builds it from these pages, without network and without running a notebook."""

import re
import shutil
from collections.abc import Container
from importlib.resources import files
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

DOCS = Path(__file__).parent
EXECUTED, TUTORIALS = DOCS.parent / "reports/notebooks", DOCS / "tutorials"  # the first is what `make tutorials` writes
FONTS = "output/chtml/fonts/woff-v2"  # of MathJax

project = "envtf_lit"
copyright = "envtf_lit contributors, MIT licence"
extensions = ["myst_nb", "sphinx_external_toc", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
exclude_patterns = ["README.md"]  # GitHub's front page of this folder, which index.md includes

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "off"
nb_render_markdown_format = "myst"  # CommonMark, which is the default, has no tables
suppress_warnings = ["etoc.glob"]  # of tutorials, where none was executed

default_role = "code"  # docstrings put code in single backticks
autodoc_default_options = {"members": True}
autodoc_inherit_docstrings = False  # Lightning's are not ours
autodoc_mock_imports = ["ray", "sbx"]  # of extras that the site does without
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88
napoleon_attr_annotations = False  # types stand in the signature
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = "envtf_lit"
html_show_sphinx = False
html_theme_options = {"top_of_page_buttons": []}
html_favicon = "_static/favicon.svg"
html_static_path = ["_static"]
html_css_files = ["site.css"]
mathjax_path = "mathjax/tex-chtml.js"


def as_rst(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Makes reStructuredText of a docstring, in which `|x|`, `a*b` and several `Code`s are what they look like."""
    parts = re.split(r"(`[^`]+`)", "\n".join(lines))
    for i, part in enumerate(parts):
        if i % 2:
            parts[i] = f"{part}\\ " if re.match(r"\w", parts[i + 1]) else part
        else:
            parts[i] = re.sub(r"[|*]", r"\\\g<0>", part)
    lines[:] = "".join(parts).split("\n")


def copy_tutorials(app: Sphinx) -> None:
    """Puts executed notebooks among the pages, and takes away those that are no more."""
    for old in TUTORIALS.glob("*.ipynb"):
        old.unlink()
    executed = {path.name: path.read_text(encoding="utf-8") for path in sorted(EXECUTED.glob("[0-9]*.ipynb"))}
    for name, text in executed.items():
        (TUTORIALS / name).write_text(moved_links(text, executed), encoding="utf-8")


def moved_links(text: str, executed: Container[str]) -> str:
    """A notebook's links as they are from docs/tutorials/; those to notebooks without a page become plain words."""

    def move(link: re.Match[str]) -> str:
        words, target = link.groups()
        if target.endswith(".ipynb") and "/" not in target:
            return link[0] if target in executed else words
        inside = target.removeprefix("../docs/")
        return f"[{words}](../{inside if inside != target else target})"

    return re.sub(r"\[([^\]\[]*)\]\((\.\./[^)\s]+|\d\w+\.ipynb)\)", move, text)


def copy_mathjax(app: Sphinx, error: Exception | None) -> None:
    """Puts MathJax and its fonts into the site, which fetches nothing."""
    source, target = Path(str(files("sphinx-mathjax-offline"))) / "static/mathjax", Path(app.outdir) / "_static/mathjax"
    shutil.copytree(source / FONTS, target / FONTS, dirs_exist_ok=True)
    shutil.copyfile(source / "tex-chtml.js", target / "tex-chtml.js")


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", as_rst, priority=400)  # before napoleon
    app.connect("builder-inited", copy_tutorials)
    app.connect("build-finished", copy_mathjax)
