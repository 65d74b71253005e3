"""What a file of a log holds, as it lies there, whatever its format."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from envtf_lit.data.findings import Finding
from envtf_lit.errors import UserError

# the first name is the one that we write
ALIASES = {
    "observations": ("observations",),
    "actions": ("actions",),
    "rewards": ("rewards",),
    "next_observations": ("next_observations",),
    "terminated": ("terminals", "terminated"),
    "truncated": ("timeouts", "truncated"),
    "episode_index": ("episode_index", "episode", "episode_id", "episode_ids"),
}
ATTRIBUTES = ("task", "action_low", "action_high")
HELD_OUT = "held_out"  # (E,), for each episode whether it is held out
# no log of numbers shrinks to a 200th: a file that declares more than this, and more than that, is damaged or a trap
BOMB_RATIO, BOMB_BYTES = 200, 256 << 20
LARGEST_ATTRIBUTE = 1 << 20  # bytes


@dataclass
class Raw:
    """What a file holds, as it lies there.

    Attributes:
        columns: by our names; arrays, or what has `shape`, `dtype` and slices like one while the file is open.
        attributes: `task`, `action_low`, `action_high`, `held_out`, where there are such.
        ignored: names of everything else.
        broken: columns that are there and cannot be read, by our names, and why.
        notes: what reading them changed.
    """

    columns: dict[str, Any] = field(default_factory=dict)
    attributes: dict[str, Any] = field(default_factory=dict)
    ignored: list[str] = field(default_factory=list)
    broken: dict[str, Finding] = field(default_factory=dict)
    notes: list[Finding] = field(default_factory=list)


def check_size(path: Path, declared: dict[str, int]) -> None:
    """Refuses sizes (bytes of each array) that make a small file a large one.

    Raises:
        UserError: the file declares hundreds of times what it holds.
    """
    total, stored = sum(declared.values()), path.stat().st_size
    if total > BOMB_BYTES and total > BOMB_RATIO * stored:
        name = max(declared, key=lambda key: declared[key])
        raise UserError(
            f"{path} has {stored:,} bytes and declares {declared[name]:,} of {name!r}: it is damaged or a trap that "
            "fills the memory; fetch or write it anew."
        )
