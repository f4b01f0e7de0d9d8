"""Points from .las files, by laspy (extra `las`)."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32


def read_las(path: Path) -> Float32[np.ndarray, "n 3"]:
    """Return the points (n, 3) of a .las file in metres, as its header scales them; the axes stay as they are.

    Raises FileNotFoundError, ImportError without the extra, and ValueError where it is no such file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        import laspy
    except ImportError as error:
        raise ImportError(f"{path}: .las files need the extra `las` (pip install 'sglpr-jax[las]')") from error
    try:
        with laspy.open(path) as stream:
            expected, found = stream.header.point_count, stream.read()
        with np.errstate(over="ignore", invalid="ignore"):
            points = np.stack([np.asarray(axis) for axis in (found.x, found.y, found.z)], axis=1).astype(np.float32)
    except Exception as error:  # laspy checks little: struct.error, MemoryError and others come through
        raise ValueError(f"{path}: expected a .las file, found none that can be read ({error})") from error
    if len(points) != expected:
        raise ValueError(f"{path}: expected {expected} points, as its header says, found {len(points)}")
    if not len(points):
        raise ValueError(f"{path}: expected at least one point, found none")
    return points
