"""Points of a scan with their times, and parts of the readers of .pcd, .ply, .las and numpy files.

Drivers write times of points in several units, relative to the scan or to an epoch. A field of times does not state its
unit. A scan takes 2 ms to 1 s, so the span of the values has one possible unit.
"""

import mmap
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Shaped

from sglpr_jax.files import in_short

MOST_POINTS = 1 << 24
"""Maximum number of points of a scan. A LiDAR of 128 beams returns about 2**18 points a turn."""
MOST_BYTES = 32 * MOST_POINTS
"""Maximum size of a scan in bytes, not compressed."""
BLOCK_POINTS = 1 << 21
"""Number of points of a point cloud map that are read at a time."""


TIME_FIELDS = ("t", "time", "timestamp", "timestamps", "time_stamp", "stamps", "offset_time", "ts", "gps_time")
"""Names of the field that drivers use for the time of a point."""
UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)
"""Possible units, in seconds."""
SHORTEST_S, LONGEST_S = 0.002, 1.0
"""Range of the duration of a scan, in seconds. It is narrower than the ratio of two units."""
ABSOLUTE_S = 10.0
"""Minimum time of a point since an epoch, in seconds. Smaller times are relative to the scan."""
SAME_CLOCK_S = 1.0
"""Maximum time between a scan and its points, in seconds, if both have the same clock."""


class TimeField(NamedTuple):
    """Times of the points of a scan, as a file or message states them."""

    name: str
    """Name of the field."""
    values: Shaped[np.ndarray, " n"]
    """Numbers of the field, one per point, in an unknown unit."""

    def seconds(self, *, valid: Bool[np.ndarray, " n"], scan_time: float | None) -> Float32[np.ndarray, " n"]:
        """Return the time of each point relative to the time of its scan, in seconds.

        Relative times stay relative to the scan's time. Times since an epoch are compared with the scan's time. If
        that has another clock or is unknown, the first point has the time of the scan.

        Arguments:
          valid: True for points that were measured. The other points may have any time, and get 0.
          scan_time: Time of the scan in seconds, or None.

        Raises:
          ValueError: If the span of the times is not that of a scan in any unit.
        """
        values = np.where(valid & np.isfinite(self.values), self.values, np.nan).astype(np.float64)
        if np.isnan(values).all():
            raise ValueError(f"expected times of points in the field {self.name}, found no finite ones")
        first, last = np.nanmin(values), np.nanmax(values)
        unit_s = next((unit for unit in UNITS_S if SHORTEST_S <= (last - first) * unit <= LONGEST_S), None)
        if unit_s is None:
            raise ValueError(
                f"expected times of points over {SHORTEST_S:g} to {LONGEST_S:g} s in the field {self.name}, found "
                f"{first:.10g} to {last:.10g}, which no unit from s to ns makes so"
            )
        return np.nan_to_num(values * unit_s - _origin_s(first * unit_s, scan_time)).astype(np.float32)


def _origin_s(first_s: float, scan_time: float | None) -> float:
    """Time of the scan on the clock of its points, which begin at `first_s`."""
    if abs(first_s) < ABSOLUTE_S:
        return 0.0
    return first_s if scan_time is None or abs(first_s - scan_time) > SAME_CLOCK_S else scan_time


def time_field_of(names: Collection[str]) -> str | None:
    """Return the name of the field of times among the fields of a point, or None."""
    return next((name for name in TIME_FIELDS if name in names), None)


class Records(NamedTuple):
    """Points of one scan, with their lasers and times."""

    points: Float32[np.ndarray, "n 3"]
    """Points in metres: x forward, y left, z up if the format defines its axes, or else the axes of the file."""
    lasers: Int32[np.ndarray, " n"] | None = None
    """Laser number of each point, or None if the format has none."""
    times: TimeField | None = None
    """Field with the times of the points, or None if the format has none."""


def records_of(columns: Sequence[np.ndarray], time: str | None) -> Records:
    """Records of the columns x, y, z and, if `time` names it, of the column of times after them."""
    with np.errstate(over="ignore", invalid="ignore"):  # invalid points are dropped by the callers
        points = np.stack(columns[:3], axis=1).astype(np.float32)
    return Records(points, times=None if time is None else TimeField(time, np.array(columns[3])))


def check_points(points: int, *, bytes_each: int = 1) -> None:
    """Raise ValueError if a header declares no points, or more points or bytes than a scan has.

    Headers may declare any size, so call this before memory is allocated.
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


def read_content(path: Path) -> bytes:
    """Return the content of a scan file. Raises ValueError if the file is missing or exceeds `MOST_BYTES`."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a {path.suffix.lower()} file, found none")
    check_bytes(path.stat().st_size)
    return path.read_bytes()


def mapped_content(path: Path) -> memoryview:
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
    """Return the numbers of text lines, NaN and infinity included. Numbers are separated by white space.

    Raises:
      ValueError: If there are other than `rows` lines, or a line does not have `columns` numbers.
    """
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
