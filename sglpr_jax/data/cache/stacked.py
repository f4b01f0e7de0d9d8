"""Stores arrays with rows of one shape one after another in a file, and maps the file into memory."""

import contextlib
import dataclasses
import math
import mmap
import os
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from sglpr_jax.files import writing


@dataclasses.dataclass(frozen=True, eq=False)
class Stacked:
    """Arrays in a file that is mapped into memory: array i is rows `offsets[i]` to `offsets[i + 1]`.

    Indexing returns a read-only view. It raises ValueError if the checksum of the array is wrong.
    """

    path: Path
    file: mmap.mmap
    rows: np.ndarray
    offsets: tuple[int, ...]
    checksums: tuple[int, ...] | None
    """Checksum of each array. None for older files, which have no checksums."""

    def __getitem__(self, i: int) -> np.ndarray:
        start, stop = self.offsets[i : i + 2]
        if stop > start:
            self._announce(*(row * self.rows.strides[0] for row in (start, stop)))
        array = self.rows[start:stop]
        if self.checksums is not None and self.checksums[i] != (found := _checksum(array)):
            raise ValueError(
                f"{self.path}: expected array {i} with the checksum {self.checksums[i]} of pack.json, found {found};"
                " delete its folder to pack the recording again"
            )
        return array

    def _announce(self, start: int, stop: int) -> None:
        """Request these bytes from the disk at once. By default, the system reads 128 KiB at each first access."""
        page = start - start % mmap.PAGESIZE
        self.file.madvise(mmap.MADV_WILLNEED, page, stop - page)


class StackWriter:
    """Writes arrays one after another into a new file. All arrays must have rows like those of `first`."""

    def __init__(self, path: Path, first: np.ndarray):
        self._path, self._dtype, self._row = path, first.dtype, first.shape[1:]
        self._offsets: list[int] = [0]
        self._checksums: list[int] = []
        with writing(path):
            self._stream = path.open("xb")

    def append(self, array: np.ndarray, *, of: str) -> None:
        """Append an array. Raises ValueError, whose message names `of`, if the rows do not fit, and OSError if the disk
        is full.
        """
        if (array.dtype, array.shape[1:]) != (self._dtype, self._row):
            raise ValueError(
                f"{of}: expected {self._dtype} with rows of shape {self._row}, like the first array of the pack, "
                f"found {array.dtype} {array.shape[1:]}"
            )
        array = np.ascontiguousarray(array)
        with writing(self._path):
            self._stream.write(array.data)
        self._checksums.append(_checksum(array))
        self._offsets.append(self._offsets[-1] + len(array))

    def finish(self) -> dict[str, Any]:
        """Flush the file to disk and return its layout, the keyword arguments of `map_stacked`."""
        with writing(self._path):
            sync(self._stream)
        lies = {"dtype": self._dtype.str, "row": self._row, "offsets": self._offsets}
        return {**lies, "checksums": self._checksums}

    def close(self) -> None:
        """Close the file, whether finished or not."""
        with contextlib.suppress(OSError):  # An earlier write error is already being raised.
            self._stream.close()


def map_stacked(
    path: Path, *, dtype: str, row: Sequence[int], offsets: Sequence[int], checksums: Sequence[int] | None = None
) -> Stacked:
    """Map a file written by `StackWriter` into memory. The keyword arguments are those that `finish` returned.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file has the wrong size, or if the arguments contradict each other. Access to the missing part
        of a file that is too short would kill the process.
    """
    if any(type(number) is not int for number in (*offsets, *row)) or sorted(offsets) != [*offsets] or offsets[0] != 0:
        raise ValueError(f"{path.name}: expected offsets in ascending order from 0, found {offsets!s:.60}")
    if checksums is not None and [type(number) for number in checksums] != [int] * (len(offsets) - 1):
        raise ValueError(f"{path.name}: expected {len(offsets) - 1} checksums, found {checksums!s:.60}")
    shape = (offsets[-1], *row)
    expected, found = np.dtype(dtype).itemsize * math.prod(shape), path.stat().st_size
    if expected != found:
        raise ValueError(f"{path.name}: expected {expected} bytes, found {found}")
    with path.open("rb") as stream:
        file = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    rows = np.frombuffer(file, dtype).reshape(shape)
    return Stacked(path, file, rows, tuple(offsets), None if checksums is None else tuple(checksums))


def _checksum(array: np.ndarray) -> int:
    """CRC-32 of type, shape and content of an array: 0.2 ms for a scan of 120,000 points."""
    return zlib.crc32(array.data, zlib.crc32(f"{array.dtype.str} {array.shape}".encode()))


def sync(stream: IO) -> None:
    """Flush a file to disk. If the file were renamed before, a power failure could leave it incomplete."""
    stream.flush()
    os.fsync(stream.fileno())
