"""The options of the stage `download`, and what those of agents rest on."""

from dataclasses import dataclass
from typing import Literal

from envtf_lit.errors import UserError
from envtf_lit.options.numbers import InnerShare, Rows

# gradient steps of an agent per Lightning training step: no host synchronisation between them. Here and not beside
# what loads them, because options are read without torch
UPDATES_PER_STEP = 10


@dataclass(frozen=True)
class DownloadOptions:
    """Where the dataset comes from.

    Attributes:
        source: `zoo` lets the shipped behaviour policies act in MuJoCo; `file` reads a file of yours; `d4rl` and
            `minari` fetch those collections' datasets, or read a copy.
        path: the HDF5 or NPZ file of `source: file`; of `source: d4rl` a copy of its file, null downloads it.
        minari_id: of `source: minari`, such as `mujoco/hopper/medium-v0`, or its folder.
        transitions: rows to collect from the zoo.
        held_out: share of the episodes that nothing learns from, for validation and evaluation; a file that names its
            own keeps them.
    """

    source: Literal["zoo", "file", "d4rl", "minari"] = "zoo"
    path: str | None = None
    minari_id: str | None = None
    transitions: Rows = 100_000
    held_out: InnerShare = 0.1


def check_download(options: DownloadOptions, *, named: bool) -> None:
    """What the source needs is there, and what it has no use for is not; `named` is whether there is a task.

    Raises:
        UserError: an option is missing or not wanted.
    """
    if not named and options.source in ("zoo", "d4rl"):
        raise UserError(
            f"task is null and download.source is {options.source!r}, which has our robots' data alone: name one "
            "of the tasks, or set download.source to 'file'."
        )
    for name, needed, wanted, what in (
        ("path", ("file",), ("file", "d4rl"), "the path of your HDF5 or NPZ file"),
        ("minari_id", ("minari",), ("minari",), "the dataset's id, such as mujoco/hopper/medium-v0"),
    ):
        value, source = getattr(options, name), options.source
        if value is None and source in needed:
            raise UserError(f"download.source is {source!r} and download.{name} is null: give {what}.")
        if value is not None and source not in wanted:
            raise UserError(
                f"download.{name} is {value!r} and download.source is {source!r}, which has no use for it: set "
                f"download.source to {wanted[0]!r}, or download.{name} to null."
            )
