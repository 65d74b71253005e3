"""Reading and writing of D4RL-style HDF5 and NPZ files; docs/datasets.md names the columns.

Nothing in a file can run code or lead elsewhere: no objects, no pickle, no links, no storage outside the file, no
filters but HDF5's own, no sizes that the file itself cannot hold.
"""

import math
import struct
import warnings
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import h5py
import numpy as np

from envtf_lit.data.action_space import PLACES, gather_limits
from envtf_lit.data.checks import build_dataset
from envtf_lit.data.columns import Column, FileRows, column_blocks
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.findings import Finding
from envtf_lit.data.sources.raw import ALIASES, ATTRIBUTES, HELD_OUT, LARGEST_ATTRIBUTE, Raw, check_size
from envtf_lit.errors import UserError
from envtf_lit.files import replacing

ALL_PLACES = tuple(place for places in PLACES.values() for place in places)
HDF5_ENDINGS, NPZ_ENDINGS = (".h5", ".hdf5"), (".npz",)
HDF5_FILTERS = {1, 2, 3, 4, 5, 6, 32000}  # gzip, shuffle, fletcher32, szip, nbit, scaleoffset, lzf: no plugins
ODD = "neither a short text nor a few numbers"
# of a file with more than this, columns of more than a quarter of it stay there and are read as they are needed
RESIDENT_BYTES = 256 << 20


def save_dataset(dataset: OfflineDataset, path: str | Path) -> None:
    """Writes a dataset by the file's ending (.h5, .hdf5, .npz); equal datasets give equal bytes.

    Raises:
        UserError: another ending, a full disk, or a place that cannot be written. Nothing half-written stays.
    """
    path = Path(path)
    write = _write_hdf5 if is_hdf5(path) else _write_npz
    arrays = {ALIASES[column][0]: getattr(dataset, column) for column in ALIASES if column != "episode_index"}
    if dataset.held_out is not None:
        arrays[HELD_OUT] = dataset.held_out
    attributes = {name: getattr(dataset, name) for name in ATTRIBUTES if getattr(dataset, name) is not None}
    with replacing(path) as temporary:
        write(temporary, arrays, attributes)


def load_dataset(path: str | Path, *, task: str | None = None) -> OfflineDataset:
    """Reads and checks a dataset.

    Integer and float64 columns become float32, 0/1 columns bool. Where `next_observations` is missing, a row's
    successor is the next row of its episode, and the last row of each episode, having none, is dropped; the log then
    no longer shows how episodes ended, so prefer files that have it. A last row without an ending is marked truncated.
    Without `action_low` and `action_high` the limits are the task's, else [-1, 1] if the actions fill that.

    Args:
        path: an HDF5 (.h5, .hdf5) or NPZ file.
        task: such as `hopper-medium-replay`; None takes the name in the file, where there is one.

    Raises:
        UserError: the file is missing, damaged, incomplete, inconsistent, or does not fit the task.
    """
    with open_raw(path) as raw:
        return build_dataset(raw.columns, raw.attributes, task=task, source=str(path), broken=raw.broken)


def stored_task(path: str | Path) -> str | None:
    """The task that a dataset file says it was made for, without reading its rows.

    Raises:
        UserError: the file is missing or damaged.
    """
    with open_raw(path) as raw:
        name = raw.attributes.get("task")
    return name.decode(errors="replace") if isinstance(name, bytes) else None if name is None else str(name)


@contextmanager
def open_raw(path: str | Path) -> Iterator[Raw]:
    """Opens a file for reading its columns; they may be used inside the block alone.

    Raises:
        UserError: the file is missing, may not be read, is none of its kind, or is made to do harm.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path} is not a file: check the path, or run the stage that writes it.")
    opening, kind = (_open_hdf5, "an HDF5") if is_hdf5(path) else (_open_npz, "an NPZ")
    file = None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what is odd in a file, the findings speak
            file, raw = opening(path)
    except UserError:
        raise
    except BlockingIOError:
        raise UserError(
            f"{path} is open for writing in another program: close it there (where a file system knows no locks, set "
            "HDF5_USE_FILE_LOCKING=FALSE)."
        ) from None
    except PermissionError:
        raise UserError(f"{path} may not be read: change its permissions.") from None
    except Exception as error:  # whatever a decoder of foreign bytes raises
        reason = " ".join(str(error).split())[:300]
        raise UserError(f"{path} is damaged or not {kind} file ({reason}): fetch or write it anew.") from None
    try:
        yield raw
    finally:
        file.close()


def is_hdf5(path: Path) -> bool:
    """Whether the ending says HDF5 rather than NPZ.

    Raises:
        UserError: it says neither.
    """
    ending = path.suffix.lower()
    if ending not in HDF5_ENDINGS + NPZ_ENDINGS:
        raise UserError(
            f"{path} ends in {ending!r}: name a dataset .h5, .hdf5 or .npz, as `envtf data convert` writes it."
        )
    return ending in HDF5_ENDINGS


def _write_hdf5(path: Path, arrays: dict[str, Column], attributes: dict[str, Any]) -> None:
    # through Python's own file: a full disk is then an OSError with its number, and early
    with path.open("w+b") as stream, h5py.File(stream, "w") as file:
        for name, array in arrays.items():
            column = file.create_dataset(name, array.shape, array.dtype, track_times=False)
            for block in column_blocks(array):
                column[block] = array[block]
        file.attrs.update(attributes)


def _write_npz(path: Path, arrays: dict[str, Column], attributes: dict[str, Any]) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in (arrays | {name: np.asarray(value) for name, value in attributes.items()}).items():
            member = zipfile.ZipInfo(f"{name}.npy")  # of 1980, whatever the clock says
            with archive.open(member, "w", force_zip64=True) as stream:
                layout = {"descr": np.lib.format.dtype_to_descr(array.dtype), "fortran_order": False}
                np.lib.format.write_array_header_1_0(stream, layout | {"shape": array.shape})
                for block in column_blocks(array) if array.shape else [...]:
                    stream.write(np.ascontiguousarray(array[block]).tobytes())


def _find_names(present: Iterable[str]) -> tuple[dict[str, str], list[str]]:
    """Our column to the name it has in a file, for those that are there; and the names of nothing of ours."""
    there = list(present)
    found = {
        column: name for column, names in ALIASES.items() if (name := next((n for n in names if n in there), None))
    }
    known = {*found.values(), "task", HELD_OUT, *ALL_PLACES}
    return found, [name for name in there if name not in known]


# HDF5


def _open_hdf5(path: Path) -> tuple[h5py.File, Raw]:
    file = h5py.File(path, "r")
    try:
        raw = Raw()
        names, raw.ignored = _find_names(file)  # iterates over names alone, following no link
        for column, name in names.items():
            item = _plain_hdf5(file, name)
            if item is None:
                what = f"there is no plain numeric array under {name!r}"
                raw.broken[column] = Finding("error", what, "store one, without links, objects or foreign filters")
            else:
                raw.columns[column] = item
        split = {} if (item := _plain_hdf5(file, HELD_OUT)) is None else {HELD_OUT: item}
        check_size(path, {name: hdf5_bytes(item) for name, item in (raw.columns | split).items()})
        if path.stat().st_size > RESIDENT_BYTES:
            raw.columns |= {name: rows for name, item in raw.columns.items() if (rows := _hdf5_rows(path, item))}
        raw.attributes |= {name: item[()] for name, item in split.items()}
        raw.attributes |= {name: _hdf5_attribute(file, name) for name in file.attrs.keys() & {"task"}}
        raw.attributes |= gather_limits({place: _hdf5_stated(file, place) for place in ALL_PLACES})
    except BaseException:
        file.close()
        raise
    return file, raw


def own_hdf5(group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset | None:
    """What lies in this very file under that name; None for what leads to another, or to the code of plugins."""
    item = group[name] if isinstance(group.get(name, getlink=True), h5py.HardLink) else None
    if isinstance(item, h5py.Group):
        return item
    if not isinstance(item, h5py.Dataset):
        return None
    plan = item.id.get_create_plist()
    filters = {plan.get_filter(index)[0] for index in range(plan.get_nfilters())}
    return None if item.external or item.is_virtual or filters - HDF5_FILTERS else item


def hdf5_bytes(item: h5py.Dataset) -> int:
    """What reading takes: all of it, and at least one chunk."""
    return item.dtype.itemsize * max(math.prod(item.shape or ()), math.prod(item.chunks or ()))


def _plain_hdf5(file: h5py.Group, name: str) -> h5py.Dataset | None:
    """A plain array of numbers."""
    item = own_hdf5(file, name)
    return item if isinstance(item, h5py.Dataset) and item.shape is not None and item.dtype.kind in "biuf" else None


def _hdf5_rows(path: Path, item: h5py.Dataset) -> FileRows | None:
    """The same array outside of HDF5, if it lies in one piece in the form that we keep it in."""
    offset = item.id.get_offset()
    plain = item.chunks is None and item.dtype == np.dtype("<f4") and item.file.userblock_size == 0
    wide = item.ndim == 2 and hdf5_bytes(item) > RESIDENT_BYTES // 4
    if not (plain and wide) or offset is None or offset + hdf5_bytes(item) > path.stat().st_size:
        return None
    return FileRows(path, offset, item.shape)


def _hdf5_stated(file: h5py.File, place: str) -> Any:
    """What is stated at a place, as an attribute or an array; None if nothing is."""
    group: Any = file
    *parents, name = place.split("/")
    for parent in parents:
        group = own_hdf5(group, parent) if isinstance(group, h5py.Group) else None
    if not isinstance(group, h5py.Group):
        return None
    if name in group.attrs:
        return _hdf5_attribute(group, name)
    if name not in group:
        return None
    item = _plain_hdf5(group, name)
    return np.array(ODD) if item is None or hdf5_bytes(item) > LARGEST_ATTRIBUTE else item[()]


def _hdf5_attribute(file: h5py.Group, name: str) -> Any:
    attribute = file.attrs.get_id(name)
    plain = attribute.dtype.kind in "biufSU" or h5py.check_string_dtype(attribute.dtype) is not None
    if not plain or math.prod(attribute.shape) * attribute.dtype.itemsize > LARGEST_ATTRIBUTE:
        return np.array(ODD)
    return file.attrs[name]


# NPZ: a zip archive of arrays


def _open_npz(path: Path) -> tuple[zipfile.ZipFile, Raw]:
    archive = zipfile.ZipFile(path)
    try:
        raw = Raw()
        for member in archive.namelist():
            if PurePosixPath(member).is_absolute() or ".." in member.replace("\\", "/").split("/"):
                raise UserError(f"{path} has a member {member[:80]!r} that leaves its folder: do not trust this file.")
        members = {name.removesuffix(".npy"): name for name in archive.namelist() if name.endswith(".npy")}
        names, raw.ignored = _find_names(members)
        arrays = {*names.values()} | ({HELD_OUT} & members.keys())
        declared = {name: archive.getinfo(members[name]).file_size for name in arrays}
        check_size(path, declared)
        for column, name in names.items():
            _read_member(raw, path, archive, members[name], column)
        stated = {}
        for name in members.keys() & {"task", HELD_OUT, *ALL_PLACES}:
            if name == HELD_OUT or archive.getinfo(members[name]).file_size <= LARGEST_ATTRIBUTE:
                with archive.open(members[name]) as stream:
                    stated[name] = np.lib.format.read_array(stream, allow_pickle=False)
        raw.attributes |= {name: stated[name] for name in ("task", HELD_OUT) if name in stated}
        raw.attributes |= gather_limits(stated)
    except BaseException:
        archive.close()
        raise
    return archive, raw


def _read_member(raw: Raw, path: Path, archive: zipfile.ZipFile, member: str, column: str) -> None:
    try:
        with archive.open(member) as stream:
            shape, columns_first, dtype = _read_header(stream)
            begin = stream.tell()
            if dtype.kind not in "biuf":
                raw.broken[column] = Finding("error", f"{column!r} holds {dtype} values", "store plain numbers")
                return
            if math.prod(shape) * dtype.itemsize > archive.getinfo(member).file_size - begin:
                raise ValueError(f"it declares shape {shape} and holds less")
            plain = dtype == np.dtype("<f4") and len(shape) == 2 and not columns_first and 0 not in shape
            large = path.stat().st_size > RESIDENT_BYTES and archive.getinfo(member).file_size > RESIDENT_BYTES // 4
            if plain and large and (start := _stored_at(path, archive, member)):
                raw.columns[column] = FileRows(path, start + begin, (shape[0], shape[1]))
                return
        with archive.open(member) as stream:
            raw.columns[column] = np.lib.format.read_array(stream, allow_pickle=False)
    except Exception as error:  # whatever a decoder of foreign bytes raises
        reason = " ".join(str(error).split())[:200]
        raw.broken[column] = Finding("error", f"{column!r} is damaged ({reason})", "fetch or write the file anew")


def _stored_at(path: Path, archive: zipfile.ZipFile, member: str) -> int | None:
    """Where in the file a member begins, None if it is compressed."""
    info = archive.getinfo(member)
    if info.compress_type != zipfile.ZIP_STORED:
        return None
    with path.open("rb") as file:
        file.seek(info.header_offset + 26)
        name, extra = struct.unpack("<HH", file.read(4))  # their lengths
    start = info.header_offset + 30 + name + extra
    return start if start + info.file_size <= path.stat().st_size else None


def _read_header(stream: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(stream)
    if version == (2, 0):
        return np.lib.format.read_array_header_2_0(stream)
    raise ValueError(f"version {version} of the format is for records, not numbers")
