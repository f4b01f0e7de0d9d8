"""Voxels of a point cloud: their numbers, and one point for each."""

import numpy as np
from jaxtyping import Float, Int64

_ROW = 1 << 21
"""Number of voxels in a row. Coordinates beyond begin a row again."""
ABOVE = _ROW**2
"""Difference between the number of a voxel and that of the voxel below it."""


def voxel_numbers(points: Float[np.ndarray, "n 3"], edge_m: float) -> Int64[np.ndarray, " n"]:
    """Return the number of the voxel of each point, for voxels with an edge of `edge_m` metres."""
    x, y, z = (np.floor(points.T.astype(np.float64) / edge_m).astype(np.int64) + _ROW // 2) % _ROW
    return z * ABOVE + y * _ROW + x


def one_per_voxel(points: Float[np.ndarray, "n 3"], edge_m: float) -> Float[np.ndarray, "m 3"]:
    """Return the first point of each voxel, in their order."""
    _, first_rows = np.unique(voxel_numbers(points, edge_m), return_index=True)
    return points[np.sort(first_rows)]
