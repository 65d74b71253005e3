"""Where a command may write its result: where nothing lies, or an earlier result of the same command."""

import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from envtf_lit.errors import UserError


def claim(out: Path, mark: str, beside: Sequence[Path] = ()) -> None:
    """Makes sure, before any work, that a command's result takes the place of nothing else.

    Args:
        out: JSON file to be written; one that holds an earlier result of the command will be replaced.
        mark: a key that every such result has, and hardly any other file.
        beside: tables and figures that are written with it.

    Raises:
        UserError: something else lies at one of these places, or `out` is one of those beside it.
    """
    if any(out in (path, *path.parents) for path in beside):
        raise UserError(f"A table or a figure would take the place of {out} itself: choose a name ending in .json.")
    if not has(read_or_none(out), mark):
        refuse_others((out, *beside), "no earlier result of this command; move it, or choose another --out")


def refuse_others(places: Iterable[Path], words: str) -> None:
    """Raises UserError, which names the places where something lies and says these words of it."""
    taken = [str(path) for path in places if os.path.lexists(path)]
    if taken:
        raise UserError(f"{', '.join(taken)} would be replaced, and is {words}.")


def read_or_none(path: Path) -> Any:
    """What a JSON file holds; None of a file that is missing, cannot be read, or is no JSON."""
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return None


def has(content: Any, *keys: str) -> bool:
    """Whether it is an object with these keys."""
    return isinstance(content, dict) and content.keys() >= set(keys)
