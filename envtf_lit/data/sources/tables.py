"""Columns of tables, Parquet's and CSV's: which of ours each is, by the names that robots' logs use; and CSV itself.

Names are LeRobot's (`observation.state`, `action`, `next.reward`, `next.done`, `episode_index`), ours, and those of a
dimension each: `observation.state.0`, `action_1`, `state[2]`.
"""

import csv
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd

from envtf_lit.data.findings import Finding
from envtf_lit.data.sources.raw import ALIASES, Raw
from envtf_lit.errors import UserError

CSV = ".csv"
# the first name is the one that we write
TABLE_ALIASES = {
    "observations": ("observation.state", "observation", "observations", "state"),
    "actions": ("action", "actions"),
    "rewards": ("next.reward", "reward", "rewards"),
    "next_observations": ("next.observation.state", "next_observation", "next_observations", "next_state"),
    "terminated": ("next.terminated", "terminated", "terminals"),
    "truncated": ("next.truncated", "truncated", "timeouts"),
    "episode_index": ALIASES["episode_index"],
}
DONE = ("next.done", "done")
WIDE = re.compile(r"(.+?)[._]?\[?(\d{1,6})\]?")
MOST_COLUMNS = 100_000
NO_REASON = Finding(
    "note",
    "'next.done' says that an episode ended and not why, so it counts as truncated",
    "store 'next.terminated' to say where the task itself ended",
)


def find_columns(names: Iterable[str]) -> tuple[dict[str, list[str]], list[str]]:
    """Our column to the names that make it up in a table, dimension by dimension; and the names of nothing of ours.

    `next.done` stands in for `truncated` where a table has neither flag.
    """
    there = list(names)
    wide: dict[str, dict[int, str]] = {}
    for name in there:
        if match := WIDE.fullmatch(name):
            wide.setdefault(match[1], {})[int(match[2])] = name
    found: dict[str, list[str]] = {}
    for column, aliases in TABLE_ALIASES.items():
        whole = next((alias for alias in aliases if alias in there), None)
        apart = next((alias for alias in aliases if alias in wide), None)
        if whole is not None:
            found[column] = [whole]
        elif apart is not None and column in ("observations", "actions", "next_observations"):
            found[column] = [wide[apart][number] for number in sorted(wide[apart])]
    if not {"terminated", "truncated"} & found.keys() and (done := next((n for n in DONE if n in there), None)):
        found["truncated"] = [done]
    used = {name for parts in found.values() for name in parts}
    return found, [name for name in there if name not in used and name not in DONE]


def gaps(parts: list[str]) -> Finding | None:
    """What is wrong where a column of several parts lacks a dimension: they are numbered from 0, or from 1."""
    numbers = [int(match[2]) for name in parts if (match := WIDE.fullmatch(name))]
    if len(parts) == 1 or (numbers[0] in (0, 1) and numbers == [*range(numbers[0], numbers[0] + len(parts))]):
        return None
    return Finding("error", f"dimensions from {parts[0]!r} to {parts[-1]!r} are not all there", "write every one")


def explain_done(raw: Raw, found: dict[str, list[str]]) -> None:
    """What follows where `next.done` stands in for both flags: no row says that the task itself ended."""
    if found.get("truncated", [""])[0] in DONE and "truncated" in raw.columns:
        raw.columns["terminated"] = np.zeros(len(raw.columns["truncated"]), bool)
        raw.notes.append(NO_REASON)


def read_csv(path: Path) -> Raw:
    """The columns of a CSV file whose first line names them.

    Raises:
        UserError: it is missing, is no table, or names two columns alike.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:  # a stream: pandas would follow an address
            names = [name.strip() for name in next(csv.reader(stream), [])]
            twice = next((name for name in names if names.count(name) > 1), None) if len(names) < MOST_COLUMNS else ""
            if twice is not None:
                raise UserError(f"{path} has several columns named {twice!r}, or far too many: name each once.")
            table = pd.read_csv(stream, header=None, names=names)
        if not isinstance(table.index, pd.RangeIndex):
            raise ValueError("a row has more cells than there are names")
    except FileNotFoundError:
        raise UserError(f"{path} is not a file: check the path.") from None
    except UserError:
        raise
    except (ValueError, OSError, csv.Error) as error:  # pandas' own are ValueErrors
        reason = " ".join(str(error).split())[:300]
        raise UserError(
            f"{path} is no CSV file ({reason}): write a line of names, then one of numbers a row."
        ) from None
    raw = Raw()
    found, raw.ignored = find_columns(names)
    for column, parts in found.items():
        text = next((name for name in parts if table[name].dtype.kind not in "biuf"), None)
        if text is not None:
            raw.broken[column] = Finding("error", f"{text!r} holds text", "store plain numbers")
        elif (gap := gaps(parts)) is not None:
            raw.broken[column] = gap
        else:
            flat = column not in ("observations", "actions", "next_observations")
            raw.columns[column] = (table[parts[0]] if flat else table[parts]).to_numpy(copy=True)
    explain_done(raw, found)
    return raw
