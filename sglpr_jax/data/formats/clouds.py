"""Limits of the size of a scan, and the scan of columns of numbers. All formats of point clouds use them."""

from collections.abc import Mapping

import numpy as np

from sglpr_jax.data.scan import Scan, TimeField

MOST_POINTS = 1 << 24
"""Maximum number of points of a scan. A LiDAR of 128 beams returns about 2**18 points a turn."""
MOST_BYTES = 32 * MOST_POINTS
"""Maximum size of a scan in bytes, not compressed."""
BLOCK_POINTS = 1 << 21
"""Number of points of a point cloud map that are read at a time."""


def cloud_scan(
    columns: Mapping[str, np.ndarray] | np.ndarray, *, time: str | None = None, laser: str | None = None
) -> Scan:
    """Return the scan of the columns x, y and z in metres, and of the columns of times and laser numbers, if any."""
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
