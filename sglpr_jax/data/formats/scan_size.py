"""Bounds of the size of a scan, and blocks of larger clouds. Headers may declare any size, so it is checked first."""

import mmap
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float64

MOST_POINTS = 1 << 24
"""Maximum number of points of a scan. A LiDAR of 128 beams returns about 2**18 points a turn."""
MOST_BYTES = 32 * MOST_POINTS
"""Maximum size of a scan in bytes, not compressed."""
BLOCK_POINTS = 1 << 21
"""Number of points of a point cloud map that are read at a time."""


def check_points(points: int, *, bytes_each: int = 1) -> None:
    """Raise ValueError if a header declares no points, or more points or bytes than a scan has.

    Arguments:
      points: Declared number of points.
      bytes_each: Declared size of a point, in bytes.
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
    """Return the content of a scan file. Raises ValueError if the file exceeds `MOST_BYTES`."""
    check_bytes(path.stat().st_size)
    return path.read_bytes()


def mapped_content(path: Path) -> memoryview:
    """Return the content of a file of any size, which the system reads when it is used. Files must not be empty."""
    with path.open("rb") as stream:
        return memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))


def blocks_of(records: np.ndarray, axes: Iterable[str]) -> Iterator[Float64[np.ndarray, "_ 3"]]:
    """Yield the coordinates of records with named fields, `BLOCK_POINTS` points at a time. `axes` names x, y and z."""
    names = tuple(axes)
    for start in range(0, len(records), BLOCK_POINTS):
        block = records[start : start + BLOCK_POINTS]
        yield np.stack([block[axis].astype(np.float64) for axis in names], axis=1)
