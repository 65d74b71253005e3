"""Columns of rows, in memory or in their file, and the blocks in which both are read."""

import os
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from envtf_lit.errors import UserError

BLOCK_BYTES = 16 << 20  # columns are looked at in blocks of about this size


class FileRows:
    """Rows (N, D) of little-endian float32 that stay in their file; indexing reads into a fresh array.

    They are read, not mapped. The kernel keeps what was read lately either way, but mapped pages count as this
    process's memory, a mapped file that shrinks kills it, and runs of rows, as windows are, are read faster.

    Args:
        path: of the file, which must not be changed in place while this lives; replacing it does no harm.
        offset: of the first row, in bytes.
        shape: (N, D).
    """

    dtype = np.dtype(np.float32)
    ndim = 2

    def __init__(self, path: str | Path, offset: int, shape: tuple[int, int]) -> None:
        self.path, self.offset, self.shape = str(path), offset, shape
        self.rows: np.ndarray | None = None  # (N,) which of the file's rows these are, if not all
        self.descriptor = _Descriptor(self.path)

    def select(self, rows: np.ndarray) -> "FileRows":
        """These rows (K,), in this order, as a column of their own; nothing is read."""
        chosen = FileRows.__new__(FileRows)
        chosen.__dict__ |= self.__dict__
        chosen.rows, chosen.shape = self._numbers(rows), (len(rows), self.shape[1])
        return chosen

    def __len__(self) -> int:
        return self.shape[0]

    @property
    def nbytes(self) -> int:
        return 4 * self.shape[0] * self.shape[1]

    def __getitem__(self, index: Any) -> np.ndarray:
        """A slice, or an integer array of any shape (...): (..., D) float32."""
        if isinstance(index, slice):
            index = np.arange(*index.indices(len(self)))
        numbers = self._numbers(np.asarray(index))
        rows = np.empty((numbers.size, self.shape[1]), "<f4")
        flat, content = numbers.ravel(), rows.data.cast("B") if rows.size else None
        breaks = np.flatnonzero(np.diff(flat) != 1) + 1  # between runs of consecutive rows
        width = 4 * self.shape[1]
        for begin, end in zip([0, *breaks.tolist()], [*breaks.tolist(), len(flat)], strict=True):
            if content is not None:
                self._read(content[begin * width : end * width], self.offset + int(flat[begin]) * width)
        return rows.astype(np.float32, copy=False).reshape(*numbers.shape, self.shape[1])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[:], dtype)

    def _numbers(self, index: np.ndarray) -> np.ndarray:
        """Rows of this column as rows of the file."""
        if index.size and not (0 <= index.min() and index.max() < len(self)):
            raise IndexError(f"rows {index.min()} to {index.max()} of a column of {len(self)}")
        return index if self.rows is None else self.rows[index]

    def _read(self, into: memoryview, offset: int) -> None:
        while into:
            count = os.preadv(self.descriptor.number, [into], offset)
            if count == 0:
                raise UserError(f"{self.path} has become shorter while it was in use: run the stage again.")
            into, offset = into[count:], offset + count


class _Descriptor:
    """An open file, closed when nobody refers to it any more."""

    def __init__(self, path: str) -> None:
        self.number = os.open(path, os.O_RDONLY)
        weakref.finalize(self, os.close, self.number)


Column = np.ndarray | FileRows


def take(column: Column, rows: np.ndarray) -> Column:
    """Those rows (K,): of an array a copy, of a file another view."""
    return column.select(rows) if isinstance(column, FileRows) else column[rows]


def blocks(rows: int, row_bytes: int = 4) -> Iterator[slice]:
    """Slices that cover [0, rows), each of about `BLOCK_BYTES`."""
    size = max(1, BLOCK_BYTES // max(1, row_bytes))
    return (slice(begin, min(begin + size, rows)) for begin in range(0, rows, size))


def column_blocks(column: Column) -> Iterator[slice]:
    """`blocks` of this column."""
    return blocks(len(column), column.dtype.itemsize * int(np.prod(column.shape[1:])))
