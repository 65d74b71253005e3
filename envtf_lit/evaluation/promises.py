"""What a policy is promised to return, as a range: how imagined episodes end, and the model's error where known."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from envtf_lit.agents.trust_levels import COLUMNS, FRONTIER
from envtf_lit.errors import UserError
from envtf_lit.files import check_plain

Places = list[dict[str, float]]  # what a frontier.csv says of each actor, from the clone outward
MOST_BYTES = 1 << 20  # of a frontier.csv
ERRORS = 2.0  # standard errors of a mean promise that its range reaches to either side


@dataclass(frozen=True)
class Range:
    """Returns from `low` to `high`."""

    low: float
    high: float

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high


def mean_range(row: Mapping[str, float], held_out: Mapping[str, float]) -> Range:
    """The mean return that an actor is promised: `promise -+ (2 error + steps |b|)`, b as of `promised_range`.

    Narrower than that: what it leaves out is that episodes may share one fate.
    """
    reach = ERRORS * row["error"] + _bias(held_out) * row["steps"]
    return Range(row["promise"] - reach, row["promise"] + reach)


def promised_range(row: Mapping[str, float], held_out: Mapping[str, float]) -> Range:
    """The return that an actor of the frontier is promised, as a range: `[low - steps |b|, high + steps |b|]`.

    From `low` to `high` lie the returns of nine of ten imagined episodes. Not their mean: where a robot always begins
    alike, its episodes share one fate, and what the model takes for the fate of some may be that of all. Of 23 actors
    of five trainings, two robots', 21 had a true mean in there, and 8 within two standard errors of the promised one
    (docs/log/trust.md); the quantiles were chosen on these.

    `b` is what the model errs by per step where the truth is known: of the held-out episodes, whose actions it is given
    and nothing else, the mean imagined return less the mean recorded one, divided by their steps. Longer imagined
    episodes make the range wider. The model's doubt and its bias are different things: on the log of a
    machine that was held back the one was 5 and the other 780 of a return of 2,850.

    Args:
        row: of `frontier.csv`: `low`, `high` and `steps`.
        held_out: of the metrics (`metrics.held_out_metrics`).
    """
    reach = _bias(held_out) * row["steps"]
    return Range(row["low"] - reach, row["high"] + reach)


def _bias(held_out: Mapping[str, float]) -> float:
    return abs(held_out["imagined_return_mean"] - held_out["return_mean"]) / max(1.0, held_out["steps_mean"])


def read_frontier(folder: Path) -> Places | None:
    """The frontier in a policy's folder, from the clone outward; None of a policy that has none.

    Raises:
        UserError: it is damaged, or lacks a column.
    """
    path = folder / f"{FRONTIER}.csv"
    if not path.exists():
        return None
    check_plain(path, MOST_BYTES)
    try:
        table = pd.read_csv(path)
    except (UnicodeDecodeError, pd.errors.ParserError, pd.errors.EmptyDataError):
        table = pd.DataFrame()
    lacking = {*COLUMNS, "kept"} - {*table.columns}
    if lacking or not (bool(table.notna().to_numpy().all()) and list(table["kept"]).count(1) == 1):
        what = f"it has no {' and no '.join(sorted(lacking))}" if lacking else "it does not name one actor as kept"
        raise UserError(f"{path} is damaged or of another version ({what}): train the policy anew.")
    return [{str(name): float(value) for name, value in row.items()} for row in table.to_dict("records")]


def kept(frontier: Places) -> dict[str, float]:
    """What is said of the published actor."""
    return next(row for row in frontier if row["kept"] == 1)
