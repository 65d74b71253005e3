"""What notebooks show: sentences, tables, pictures, and figures that are drawn on the spot."""

import base64
import inspect
import os
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from textwrap import dedent
from typing import Any

import pandas as pd
from IPython.display import HTML, Markdown, display
from rich.console import Console, RenderableType

WIDTH = 110  # characters of what would be printed on a terminal


def say(*sentences: str) -> None:
    """Displays sentences as one paragraph; empty ones are left out."""
    display(Markdown(" ".join(sentence for sentence in sentences if sentence)))


def show(table: pd.DataFrame) -> None:
    """Displays a table of text, without row numbers."""
    display(HTML(table.to_html(index=False, border=0)))


def show_source(thing: Any) -> None:
    """Displays the source of a function or class of ours, without its docstring."""
    source = dedent(inspect.getsource(thing))
    source = re.sub(r'^( *)""".*?"""\n+', "", source, count=1, flags=re.DOTALL | re.MULTILINE)
    display(Markdown(f"```python\n{source}```"))


def show_picture(path: Path, text: str) -> None:
    """Displays a PNG or GIF.

    As HTML, for nbconvert shows no GIF otherwise, and gives no picture a text for those who cannot see it.
    """
    content = base64.b64encode(path.read_bytes()).decode()
    display(HTML(f'<img alt="{text}" src="data:image/{path.suffix[1:]};base64,{content}">'))


def draw(plot: Callable[..., object], *given: Any, alt: str, ending: str = "png", **named: Any) -> None:
    """Displays what one of our figures draws.

    Args:
        plot: a function of `envtf_lit.figures`, whose `path` is given here.
        given, named: its other arguments.
        alt: what the picture shows, for those who cannot see it.
        ending: `png`, or `gif` of what writes a video.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"picture.{ending}"
        plot(*given, path=path, **named)
        show_picture(path, alt)


def show_printed(*things: RenderableType) -> None:
    """Displays what a command would print on a terminal, without its colours."""
    with open(os.devnull, "w") as nowhere:
        console = Console(file=nowhere, record=True, width=WIDTH, markup=False, highlight=False, force_jupyter=False)
        console.print(*things, sep="\n")
    print(console.export_text())


def enter_folder(folder: str) -> None:
    """Makes a folder and the current one, so that the names of files in outputs do not depend on where it lies.

    Args:
        folder: where files are written; empty takes a new temporary one.
    """
    place = Path(folder or tempfile.mkdtemp(prefix="envtf-tutorial-")).resolve()
    place.mkdir(parents=True, exist_ok=True)
    os.chdir(place)
