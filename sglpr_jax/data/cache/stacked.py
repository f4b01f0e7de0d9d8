"""Arrays with rows of one shape, one after another in a file: written once, then mapped into memory."""

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
    """Arrays one after another in a file that is mapped into memory: array i is rows `offsets[i]` to `offsets[i + 1]`.

    What is asked for is a view, to read only. Raises ValueError where its bytes are not those that were written.
    """

    path: Path
    file: mmap.mmap
    rows: np.ndarray
    offsets: tuple[int, ...]
    checksums: tuple[int, ...] | None
    """Of each array; None in a file of the time before there were any."""

    def __getitem__(self, i: int) -> np.ndarray:
        start, stop = self.offsets[i : i + 2]
        if stop > start:
            self._announce(*(row * self.rows.strides[0] for row in (start, stop)))
        array = self.rows[start:stop]
        if self.checksums is not None and self.checksums[i] != (found := _checksum(array)):
            raise ValueError(
                f"{self.path}: expected array {i} with the checksum {self.checksums[i]}, as pack.json says, found"
                f" {found}; once its folder is removed the recording is packed anew"
            )
        return array

    def _announce(self, start: int, stop: int) -> None:
        """Have the disk read these bytes at once: the system by itself reads 128 KiB at each first touch."""
        page = start - start % mmap.PAGESIZE
        self.file.madvise(mmap.MADV_WILLNEED, page, stop - page)


class StackWriter:
    """Writes arrays one after another into a new file; all have rows like those of `first`."""

    def __init__(self, path: Path, first: np.ndarray):
        self._path, self._dtype, self._row = path, first.dtype, first.shape[1:]
        self._offsets: list[int] = [0]
        self._checksums: list[int] = []
        with writing(path):
            self._stream = path.open("xb")

    def append(self, array: np.ndarray, *, of: str) -> None:
        """Raises ValueError, naming `of`, where its rows are unlike the first array's; OSError on a full disk."""
        if (array.dtype, array.shape[1:]) != (self._dtype, self._row):
            raise ValueError(
                f"{of}: expected {self._dtype} with rows of shape {self._row}, as the first one has, to be packed with "
                f"it, found {array.dtype} {array.shape[1:]}"
            )
        array = np.ascontiguousarray(array)
        with writing(self._path):
            self._stream.write(array.data)
        self._checksums.append(_checksum(array))
        self._offsets.append(self._offsets[-1] + len(array))

    def finish(self) -> dict[str, Any]:
        """Have all on the disk, and say how it lies there."""
        with writing(self._path):
            sync(self._stream)
        lies = {"dtype": self._dtype.str, "row": self._row, "offsets": self._offsets}
        return {**lies, "checksums": self._checksums}

    def close(self) -> None:
        """To be called whether it was finished or not."""
        with contextlib.suppress(OSError):  # of what was never flushed, because of an error that is on its way
            self._stream.close()


def map_stacked(
    path: Path, *, dtype: str, row: Sequence[int], offsets: Sequence[int], checksums: Sequence[int] | None = None
) -> Stacked:
    """Map what a `StackWriter` wrote into memory; the other arguments are what its `finish` returned.

    Raises FileNotFoundError, and ValueError where the file has another size (one too short would end the process as
    soon as its missing part is touched) or the arguments do not fit each other.
    """
    if any(type(number) is not int for number in (*offsets, *row)) or sorted(offsets) != [*offsets] or offsets[0] != 0:
        raise ValueError(f"{path.name}: expected offsets that rise from 0, found {offsets!s:.60}")
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
    """CRC-32 of what an array is and holds: 0.2 ms for a scan of 120,000 points."""
    return zlib.crc32(array.data, zlib.crc32(f"{array.dtype.str} {array.shape}".encode()))


def sync(stream: IO) -> None:
    """Have a file on the disk: renamed before that, a power cut could leave one with a hole."""
    stream.flush()
    os.fsync(stream.fileno())
