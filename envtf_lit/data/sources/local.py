"""Any dataset on this machine, whatever its format."""

import contextlib
from pathlib import Path

from envtf_lit.data.sources.files import open_raw
from envtf_lit.data.sources.minari import MINARI, minari_raw
from envtf_lit.data.sources.parquet import PARQUET, is_lerobot, read_parquet
from envtf_lit.data.sources.raw import Raw
from envtf_lit.data.sources.tables import CSV, read_csv


def open_source(source: str | Path) -> contextlib.AbstractContextManager[Raw]:
    """What any dataset on this machine holds, as it lies there; its columns may be used inside the block alone.

    Args:
        source: an HDF5, NPZ, Parquet or CSV file, `minari:` and the id of a Minari dataset, or such a dataset's
            folder, or one of LeRobot's.

    Raises:
        UserError: there is nothing of that name, or it is none of these, damaged, or made to do harm.
    """
    name, path = str(source), Path(source)
    if name.startswith(MINARI):
        return contextlib.nullcontext(minari_raw(name.removeprefix(MINARI), download=False))
    if path.suffix.lower() in PARQUET or is_lerobot(path):
        return contextlib.nullcontext(read_parquet(path))
    if path.suffix.lower() == CSV:
        return contextlib.nullcontext(read_csv(path))
    if path.is_dir():
        return contextlib.nullcontext(minari_raw(path, download=False))
    return open_raw(path)
