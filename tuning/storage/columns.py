"""Arrays with a row for each draw, filled some rows at a time; large ones in a file."""

import os
import tempfile
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxtank.core.errors import InputError
from tuning.storage.store import Folder

IN_MEMORY = 1 << 24  # bytes of all arrays up to which they are held in memory
ROWS = 1 << 14  # rows that are read at once

Array = NDArray[Any]


class Columns(Mapping[str, Array]):
    """{name: (rows, ...) array}, filled some rows at a time; `put` of the first rows names them."""

    # Above IN_MEMORY bytes in an unnamed file, which each look-up maps anew: nothing stays held.

    def __init__(self, rows: int, folder: Folder | None = None):
        self.rows, self.folder = rows, folder
        self.places: dict[str, tuple[int, Array]] = {}  # {name: (first byte, array without rows)}
        self.arrays: dict[str, Array] | None = None
        self.file: Any = None

    def _allocate(self, like: Mapping[str, Array]) -> None:
        size = 0
        for name, block in like.items():
            empty = np.zeros((0, *block.shape[1:]), block.dtype)
            self.places[name] = size, empty
            size += self.rows * _row_bytes(empty)
        if size <= IN_MEMORY:
            self.arrays = {n: np.zeros((self.rows, *v.shape[1:]), v.dtype) for n, v in like.items()}
            return
        self.file = tempfile.TemporaryFile(dir=self.folder)  # noqa: SIM115  ends with this
        if hasattr(os, "posix_fallocate"):  # all of it, so that a full disk is known at once
            os.posix_fallocate(self.file.fileno(), 0, size)
        else:
            self.file.truncate(size)

    def put(self, start: int, block: Mapping[str, Array]) -> None:
        """Set the rows from `start` on to the rows of `block`; rows beyond the last are dropped."""
        try:
            if not self.places:
                self._allocate(block)
            for name, (place, empty) in self.places.items():
                new = np.asarray(block[name], dtype=empty.dtype)[: self.rows - start]
                if self.arrays is not None:
                    self.arrays[name][start : start + len(new)] = new
                    continue
                self.file.seek(place + start * _row_bytes(empty))
                self.file.write(np.ascontiguousarray(new).tobytes())
                self.file.flush()
        except OSError as error:
            folder = tempfile.gettempdir() if self.folder is None else str(self.folder)
            remedy = ", or set TMPDIR to another folder" if self.folder is None else ""
            raise InputError(
                f"{folder!r} cannot hold {self.rows} draws ({error.strerror}): free disk"
                f" space{remedy}"
            ) from None

    def __getitem__(self, name: str) -> Array:
        place, empty = self.places[name]
        if self.arrays is not None:
            return self.arrays[name]
        shape = (self.rows, *empty.shape[1:])
        return np.memmap(self.file, empty.dtype, mode="r", offset=place, shape=shape)

    def __iter__(self) -> Iterator[str]:
        return iter(self.places)

    def __len__(self) -> int:
        return len(self.places)

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, ({name: np.array(self[name]) for name in self},)


def row_blocks(rows: int, size: int | None = None) -> Iterator[slice]:
    """Return slices that cover so many rows, `size` at a time, ROWS where None."""
    size = ROWS if size is None else size
    return (slice(i, min(i + size, rows)) for i in range(0, rows, size))


def column(
    table: Mapping[str, Array], name: str, entry: int, where: Array, out: Array | None = None
) -> Array:
    """Return one entry of an array over the rows where `where` (rows,) is True, in `out`."""
    values = np.empty(int(np.sum(where)), table[name].dtype) if out is None else out
    end = 0
    for rows in row_blocks(len(where)):
        block = table[name][rows]  # a new lookup, so that earlier rows need not stay in memory
        part = block.reshape(len(block), -1)[where[rows], entry]
        values[end : end + len(part)] = part
        end += len(part)
    return values


def _row_bytes(empty: Array) -> int:
    return int(np.prod(empty.shape[1:], dtype=int)) * empty.dtype.itemsize
