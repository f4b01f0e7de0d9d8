"""Reads points from .las files with laspy (extra `las`)."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32


def read_las(path: Path) -> Float32[np.ndarray, "n 3"]:
    """Return the points (n, 3) of a .las file in metres, scaled by the header. The axes are not changed.

    Raises:
      FileNotFoundError: If the file does not exist.
      ImportError: If the extra `las` is not installed.
      ValueError: If the file is not a readable .las file, is truncated, or has no points.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a .las file, found none")
    try:
        import laspy
    except ImportError as error:
        raise ImportError(f"{path}: .las files need the extra `las` (pip install 'sglpr-jax[las]')") from error
    try:
        with laspy.open(path) as stream:
            expected, found = stream.header.point_count, stream.read()
        with np.errstate(over="ignore", invalid="ignore"):
            points = np.stack([np.asarray(axis) for axis in (found.x, found.y, found.z)], axis=1).astype(np.float32)
    except Exception as error:  # laspy raises struct.error, MemoryError and others
        raise ValueError(f"{path}: expected a .las file, found an unreadable one ({error})") from error
    if len(points) != expected:
        raise ValueError(f"{path}: expected {expected} points by the header, found {len(points)}")
    if not len(points):
        raise ValueError(f"{path}: expected at least one point, found none")
    return points
