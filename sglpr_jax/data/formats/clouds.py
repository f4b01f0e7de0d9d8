"""Limits of the size of a scan, and the conversion of columns to a `Scan`, for all formats of point clouds."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float32

from sglpr_jax.data.scan import LASER_FIELDS, TIME_FIELDS, Scan, TimeField

MOST_POINTS = 1 << 24
"""Maximum number of points of a scan. A LiDAR of 128 beams returns about 2**18 points a turn."""
MOST_BYTES = 32 * MOST_POINTS
"""Maximum uncompressed size of a scan, in bytes."""
BLOCK_POINTS = 1 << 21
"""Number of points in a block. A point cloud map is read block by block."""


def cloud_scan(
    columns: Mapping[str, np.ndarray] | np.ndarray, *, points: Float32[np.ndarray, "n 3"] | None = None
) -> Scan:
    """Create a scan from `points`, or the columns x, y and z, in metres, and from the columns of times and lasers, if
    any: the first of `TIME_FIELDS` and of `LASER_FIELDS`."""
    names = columns.dtype.names or () if isinstance(columns, np.ndarray) else columns
    time, laser = (next((name for name in known if name in names), None) for known in (TIME_FIELDS, LASER_FIELDS))
    with np.errstate(over="ignore", invalid="ignore"):  # callers drop invalid points
        if points is None:
            points = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float32)
        return Scan(
            points=points,
            lasers=None if laser is None else columns[laser].astype(np.int32),
            time_field=None if time is None else TimeField(time, np.array(columns[time])),  # copy: frees other columns
        )


def check_points(points: int, *, bytes_each: int = 1) -> None:
    """Raise ValueError if a header declares no points, or more than `MOST_POINTS` points or `MOST_BYTES` bytes."""
    if points < 1:
        raise ValueError(f"expected at least one point, found {points or 'none'}")
    if points > MOST_POINTS:
        raise ValueError(f"expected a scan of at most {MOST_POINTS} points, found {points}")
    check_bytes(points * bytes_each)


def check_bytes(size: int) -> None:
    """Raise ValueError if the declared size of a scan in bytes exceeds `MOST_BYTES`."""
    if size > MOST_BYTES:
        raise ValueError(f"expected a scan of at most {MOST_BYTES} bytes, found {size}")
