"""D4RL-style HDF5 and NPZ files, in both directions.

Keys: `observations` (N, S), `actions` (N, A), `rewards` (N,), `next_observations` (N, S), `terminals` (N,), `timeouts`
(N,); optional `task`, `action_low` (A,) and `action_high` (A,), as attributes in HDF5 and as arrays in NPZ. Reading
also takes the names `terminated` and `truncated`, and leaves other keys (`infos/...`, `metadata/...`) alone.
"""

import io
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.validation import build_dataset
from envtf_lit.errors import UserError
from envtf_lit.storage import replacing

ALIASES = {
    "observations": ("observations",),
    "actions": ("actions",),
    "rewards": ("rewards",),
    "next_observations": ("next_observations",),
    "terminated": ("terminals", "terminated"),
    "truncated": ("timeouts", "truncated"),
}
ATTRIBUTES = ("task", "action_low", "action_high")
HDF5_ENDINGS, NPZ_ENDINGS = (".h5", ".hdf5"), (".npz",)


def save_dataset(dataset: OfflineDataset, path: str | Path) -> None:
    """Writes a dataset by the file's ending (.h5, .hdf5, .npz); equal datasets give equal bytes.

    Raises:
        UserError: another ending, a full disk, or a place that cannot be written. Nothing half-written stays.
    """
    path = Path(path)
    arrays = {names[0]: getattr(dataset, column) for column, names in ALIASES.items()}
    attributes = {name: getattr(dataset, name) for name in ATTRIBUTES if getattr(dataset, name) is not None}
    content = _hdf5_bytes(arrays, attributes) if _is_hdf5(path) else _npz_bytes({**arrays, **attributes})
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def load_dataset(path: str | Path, *, task: str | None = None) -> OfflineDataset:
    """Reads and checks a dataset.

    Integer and float64 columns become float32, 0/1 columns bool. Where `next_observations` is missing, a row's
    successor is the next row of its episode, and the last row of each episode, having none, is dropped; the log then
    no longer shows how episodes ended, so prefer files that have it. A last row without an ending is marked truncated.
    Without `action_low` and `action_high` the limits are the task's, else [-1, 1].

    Args:
        path: an HDF5 (.h5, .hdf5) or NPZ file.
        task: such as `hopper-medium-replay`; None takes the name in the file, where there is one.

    Raises:
        UserError: the file is missing, damaged, incomplete, inconsistent, or does not fit the task.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path} is not a file: check the path, or run the stage that writes it.")
    read, kind = (_read_hdf5, "an HDF5") if _is_hdf5(path) else (_read_npz, "an NPZ")
    try:
        columns, attributes = read(path)
    except UserError:
        raise
    except PermissionError:
        raise UserError(f"{path} may not be read: change its permissions.") from None
    except (
        OSError,
        ValueError,
        RuntimeError,
        KeyError,
        TypeError,
        MemoryError,
        EOFError,
        NotImplementedError,
    ) as error:
        raise UserError(f"{path} is damaged or not {kind} file ({error}): fetch or write it anew.") from None
    except (zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"{path} is damaged or not {kind} file ({error}): fetch or write it anew.") from None
    return build_dataset(columns, attributes, task=task, source=str(path))


def _is_hdf5(path: Path) -> bool:
    ending = path.suffix.lower()
    if ending not in HDF5_ENDINGS + NPZ_ENDINGS:
        raise UserError(f"{path} ends in {ending!r}: name a dataset .h5, .hdf5 or .npz.")
    return ending in HDF5_ENDINGS


def _hdf5_bytes(arrays: Mapping[str, np.ndarray], attributes: Mapping[str, Any]) -> bytes:
    # in memory first: HDF5's own errors on a full disk come late and have no errno
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array, track_times=False)
        file.attrs.update(attributes)
    return buffer.getvalue()


def _npz_bytes(arrays: Mapping[str, Any]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # numpy dates every member 1980
    return buffer.getvalue()


def _find_names(present: Iterable[str]) -> dict[str, str]:
    """Our column to the name it has in a file, for those that are there."""
    there = set(present)
    return {column: name for column, names in ALIASES.items() if (name := next((n for n in names if n in there), None))}


def _read_hdf5(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    with h5py.File(path, "r") as file:
        names = _find_names(file)  # iterates over names alone, following no link
        columns = {column: _read_hdf5_array(file, name, path) for column, name in names.items()}
        return columns, {name: file.attrs[name] for name in ATTRIBUTES if name in file.attrs}


def _read_hdf5_array(file: h5py.File, name: str, path: Path) -> np.ndarray:
    """A plain array of this very file: nothing that leads to another file, no objects."""
    item = file[name] if isinstance(file.get(name, getlink=True), h5py.HardLink) else None
    if isinstance(item, h5py.Dataset) and item.shape is not None and item.dtype.kind in "biuf":
        outside = item.external or item.is_virtual
        if not outside:
            return np.asarray(item)
    raise UserError(f"{path} holds no plain numeric array under {name!r}: store one, without links or objects.")


def _read_npz(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        columns = {column: file[name] for column, name in _find_names(file.files).items()}
        return columns, {name: file[name] for name in ATTRIBUTES if name in file.files}
