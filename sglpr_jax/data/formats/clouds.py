"""Parts of the readers of point clouds: limits of sizes, packed records, rows of text, and records from columns."""

import mmap
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sglpr_jax.data.scan import Scan, TimeField
from sglpr_jax.files import in_short

MOST_POINTS = 1 << 24
"""Maximum number of points of a scan. A LiDAR of 128 beams returns about 2**18 points a turn."""
MOST_BYTES = 32 * MOST_POINTS
"""Maximum size of a scan in bytes, not compressed."""
BLOCK_POINTS = 1 << 21
"""Number of points of a point cloud map that are read at a time."""


def cloud_scan(
    columns: Mapping[str, np.ndarray] | np.ndarray, *, time: str | None = None, laser: str | None = None
) -> Scan:
    """Return the record of the columns x, y and z, and of the columns of times and laser numbers, if any."""
    with np.errstate(over="ignore", invalid="ignore"):  # invalid points are dropped by the callers
        return Scan(
            points=np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float32),
            lasers=None if laser is None else columns[laser].astype(np.int32),
            time_field=None if time is None else TimeField(time, np.array(columns[time])),
        )


def check_points(points: int, *, bytes_each: int = 1) -> None:
    """Raise ValueError if a header declares no points, or more points or bytes than a scan has.

    Call this before memory is allocated.
    """
    if points < 1:
        raise ValueError(f"expected at least one point, found {points or 'none'}")
    if points > MOST_POINTS:
        raise ValueError(f"expected a scan of at most {MOST_POINTS} points, found {points}")
    check_bytes(points * bytes_each)


def check_bytes(size: int) -> None:
    """Raise ValueError if the declared size of a scan in bytes exceeds `MOST_BYTES`."""
    if size > MOST_BYTES:
        raise ValueError(f"expected a scan of at most {MOST_BYTES} bytes, found {size}")


def mapped(path: Path) -> memoryview:
    """Return the content of a file of any size, which the system reads when it is used. Files must not be empty."""
    with path.open("rb") as stream:
        return memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))


def packed_type(fields: Iterable[tuple[str, str, int]], names: Sequence[str]) -> np.dtype:
    """Numpy type of packed fields (name, type, size in bytes), with only the fields in `names`. Names are unique."""
    wanted, offset = {}, 0
    for name, kind, size in fields:
        if name in names:
            wanted[name] = (kind, offset)
        offset += size
    kinds, offsets = zip(*wanted.values(), strict=True)
    return np.dtype({"names": list(wanted), "formats": kinds, "offsets": offsets, "itemsize": offset})


def blocks_of(records: np.ndarray) -> Iterator[Float64[np.ndarray, "_ 3"]]:
    """Yield the coordinates of records with the fields x, y and z, `BLOCK_POINTS` points at a time."""
    for start in range(0, len(records), BLOCK_POINTS):
        block = records[start : start + BLOCK_POINTS]
        yield np.stack([block[axis].astype(np.float64) for axis in "xyz"], axis=1)


_NOT_A_NUMBER = re.compile(rb"[-+]?(?:nan\([^\s()]*\)|1\.#(?:ind|[qs]?nan)\w*)", re.IGNORECASE)
"""Spellings of NaN by the C libraries of Windows and Linux: `-nan(ind)`, `nan(0x1)`, `1.#QNAN`."""


def whole_number(word: str, *, of: str) -> int:
    """Return a number of at most 18 decimal digits. Raises ValueError for other words. The message names `of`."""
    if not re.fullmatch("[0-9]{1,18}", word):
        raise ValueError(f"expected a whole number as {of}, found {word[:40]!r}")
    return int(word)


def text_lines(body: bytes) -> list[bytes]:
    """Return the lines that are not blank."""
    return [line for line in body.splitlines() if line.strip()]


def number_rows(lines: Sequence[bytes], *, rows: int, columns: int) -> Float64[np.ndarray, "{rows} {columns}"]:
    """Return the numbers of text lines, NaN and infinity included. Raises ValueError for another number of them."""
    expected = f"expected {rows} lines of {columns} numbers"
    if len(lines) != rows:
        raise ValueError(f"{expected}, found {len(lines)} lines")
    words = (_NOT_A_NUMBER.sub(b"nan", line).decode("ascii", errors="replace") for line in lines)
    try:
        found = np.loadtxt(words, np.float64, comments=None, ndmin=2)
    except ValueError as error:
        raise ValueError(f"{expected}, found others ({in_short(error)})") from error
    if found.shape != (rows, columns):
        raise ValueError(f"{expected}, found {found.shape[0]} lines of {found.shape[1]}")
    return found
