"""A finding: one thing that is wrong, odd or changed in a dataset, and what to do about it."""

from dataclasses import dataclass
from typing import Literal

Kind = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Finding:
    """One thing found in a dataset.

    Attributes:
        kind: `error` makes it unusable, a `warning` is probably not meant, a `note` says what reading changes.
        what: as a clause without a full stop, with the values.
        fix: what to do about it; empty where there is nothing to do.
    """

    kind: Kind
    what: str
    fix: str = ""

    def __str__(self) -> str:
        return f"{self.what}: {self.fix}" if self.fix else self.what
