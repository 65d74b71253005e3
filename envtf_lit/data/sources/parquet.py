"""Reading and writing of Parquet, with the columns that LeRobot's logs have (https://github.com/huggingface/lerobot).

A file is read column by column: lists of equal length, or plain numbers. No value is an object, and nothing is run.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from envtf_lit.data.columns import blocks
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.findings import Finding
from envtf_lit.data.sources.raw import ATTRIBUTES, HELD_OUT, LARGEST_ATTRIBUTE, Raw, check_size
from envtf_lit.data.sources.tables import TABLE_ALIASES, explain_done, find_columns, gaps
from envtf_lit.errors import UserError, missing_extra
from envtf_lit.files import replacing

PARQUET = (".parquet", ".pq")
METADATA = b"envtf_lit"  # our key in the schema: JSON of the limits, the task, and which episodes are held out
FIX = "store numbers, or lists of equally many numbers, without nulls"


def write_parquet(dataset: OfflineDataset, path: str | Path) -> None:
    """Writes a dataset with LeRobot's columns, next observations and both flags beside them; nothing is lost.

    Raises:
        UserError: the extra `parquet` is missing, the disk is full, or the place cannot be written. Nothing
            half-written stays.
    """
    pa, pq = _pyarrow()
    episode = np.repeat(np.arange(len(dataset.episode_starts)), dataset.episode_lengths)
    frame = np.arange(len(dataset)) - dataset.episode_starts[episode]
    facts = {name: value for name in ATTRIBUTES if (value := getattr(dataset, name)) is not None}
    if dataset.held_out is not None:
        facts[HELD_OUT] = dataset.held_out
    plain = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in facts.items()}
    columns: dict[str, Any] = {
        TABLE_ALIASES[name][0]: getattr(dataset, name) for name in TABLE_ALIASES if name != "episode_index"
    }
    columns |= {"next.done": dataset.terminated | dataset.truncated, "episode_index": episode, "frame_index": frame}

    def table(block: slice) -> Any:
        return pa.table({name: _arrow(pa, values[block]) for name, values in columns.items()}).replace_schema_metadata(
            {METADATA: json.dumps(plain)}
        )

    width = 4 * (2 * dataset.observations.shape[1] + dataset.actions.shape[1])
    schema = table(slice(0, 0)).schema
    with (
        replacing(path) as temporary,
        temporary.open("wb") as stream,
        pq.ParquetWriter(stream, schema, compression="zstd") as writer,
    ):
        for block in blocks(len(dataset), width):
            writer.write_table(table(block))


def read_parquet(path: Path) -> Raw:
    """The columns of a Parquet file, or of all such files of a LeRobot dataset's folder, in the order of their names.

    Raises:
        UserError: the extra `parquet` is missing, or a file is missing, damaged, of other columns than the first one,
            or declares far more than it holds.
    """
    _, pq = _pyarrow()
    files = sorted((path / "data").rglob("*.parquet")) if path.is_dir() else [path]
    parts = [_read(file, pq) for file in files]
    first, *others = parts
    for file, other in zip(files[1:], others, strict=True):
        if other.columns.keys() != first.columns.keys() or other.broken.keys() != first.broken.keys():
            raise UserError(f"{file} has other columns than {files[0]}: convert them one by one.")
    for name in first.columns if others else ():
        try:
            first.columns[name] = np.concatenate([part.columns[name] for part in parts])
        except ValueError:
            raise UserError(f"{path} has files whose {name!r} differ in width: convert them one by one.") from None
    return first


def is_lerobot(folder: Path) -> bool:
    """Whether a folder is laid out as LeRobot's datasets are: Parquet files below `data/`."""
    return (folder / "meta/info.json").is_file() and any((folder / "data").rglob("*.parquet"))


def _read(path: Path, pq: Any) -> Raw:
    if not path.is_file():
        raise UserError(f"{path} is not a file: check the path.")
    try:
        with path.open("rb") as stream:
            file = pq.ParquetFile(stream)
            raw = Raw()
            found, raw.ignored = find_columns(file.schema_arrow.names)
            wanted = {name for names in found.values() for name in names}
            check_size(path, _declared(file.metadata, wanted))
            for column, names in found.items():
                _read_column(raw, file, column, names)
            raw.attributes = _attributes(file.schema_arrow.metadata or {})
    except UserError:
        raise
    except Exception as error:  # whatever a decoder of foreign bytes raises
        reason = " ".join(str(error).split())[:300]
        raise UserError(f"{path} is damaged or not a Parquet file ({reason}): fetch or write it anew.") from None
    explain_done(raw, found)
    return raw


def _declared(metadata: Any, wanted: set[str]) -> dict[str, int]:
    """Bytes that each column takes in memory: a run of equal values is next to nothing in the file."""
    sizes = dict.fromkeys(wanted, 0)
    for group in range(metadata.num_row_groups):
        for index in range(metadata.num_columns):
            chunk = metadata.row_group(group).column(index)
            path = chunk.path_in_schema
            for name in wanted:
                if path == name or path.startswith(f"{name}."):
                    sizes[name] += max(8 * chunk.num_values, chunk.total_uncompressed_size)
    return sizes


def _read_column(raw: Raw, file: Any, column: str, names: list[str]) -> None:
    wrong = gaps(names)
    arrays = []
    for name in names if wrong is None else ():
        values = file.read(columns=[name]).column(name).combine_chunks()
        array = _numpy(values)
        if array is None:
            wrong = Finding("error", f"{name!r} holds {values.type} with {values.null_count} nulls", FIX)
            break
        arrays.append(array)
    if wrong is not None:
        raw.broken[column] = wrong
        return
    raw.columns[column] = arrays[0] if len(names) == 1 else np.stack(arrays, 1)


def _numpy(values: Any) -> np.ndarray | None:
    """(N,) of plain numbers, (N, D) of lists of D numbers; None of anything else."""
    pa, _ = _pyarrow()
    kind = values.type
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        flat = None if values.null_count else _numpy(values.flatten())
        rows = len(values)
        lengths = set(values.value_lengths().unique().to_pylist())
        if flat is None or flat.ndim != 1 or len(lengths) != 1:
            return None
        return flat.reshape(rows, lengths.pop())
    plain = pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)
    return np.array(values.to_numpy(zero_copy_only=False)) if plain and not values.null_count else None


def _attributes(metadata: dict[bytes, bytes]) -> dict[str, Any]:
    """What `write_parquet` left beside the columns; anything else is checked as what any file states."""
    text = metadata.get(METADATA, b"{}")
    facts = json.loads(text) if len(text) <= LARGEST_ATTRIBUTE else None
    if not isinstance(facts, dict):
        raise ValueError("the facts in its schema are no JSON object of a readable size")
    return {
        name: value if name == "task" else np.asarray(value)
        for name, value in facts.items()
        if name in (*ATTRIBUTES, HELD_OUT)
    }


def _arrow(pa: Any, values: np.ndarray) -> Any:
    if values.ndim == 1:
        return pa.array(values)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])


def _pyarrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise missing_extra("Parquet needs pyarrow", "parquet", error) from None
    return pyarrow, pyarrow.parquet
