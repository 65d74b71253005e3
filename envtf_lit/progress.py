"""What is said while work goes on, on standard error: what a command prints is its result."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn


@contextmanager
def progress_bar(
    title: str, total: int, *columns: ProgressColumn, visible: bool = True, **fields: Any
) -> Iterator[Callable[..., None]]:
    """Yields what moves the bar: rich's `Progress.update`, which takes `advance` or `completed`.

    Args:
        title: stands before the bar.
        total: at which it is full.
        columns: what stands between the bar and the time left; none means "so many of so many".
        visible: False shows nothing.
        fields: first values of what `columns` show.
    """
    middle = columns or (MofNCompleteColumn(),)
    layout = (TextColumn("{task.description}"), BarColumn(), *middle, TimeRemainingColumn())
    with Progress(*layout, console=Console(stderr=True), disable=not visible) as bar:
        yield partial(bar.update, bar.add_task(title, total=total, **fields))


def note(sentence: str) -> None:
    """A sentence in yellow, as it is: brackets in a path are no markup, and lines are not broken."""
    Console(stderr=True).print(sentence, style="yellow", markup=False, highlight=False, soft_wrap=True)
