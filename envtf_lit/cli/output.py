"""What commands print with."""

import logging

from rich.console import Console


def console(*, stderr: bool = False) -> Console:
    """A console that prints text as it is: brackets in a path are no markup, and lines are not broken."""
    return Console(stderr=stderr, markup=False, emoji=False, highlight=False, soft_wrap=True)


def hush_lightning() -> None:
    """A command of ours shows progress and a result; Lightning's hints help nobody."""
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)
