"""Voxel filter: one point for each occupied voxel of a scan."""

import numpy as np
from jaxtyping import Float, Float64, Int64


def voxel_means(points: Float[np.ndarray, "n 3"], side_m: float) -> Float64[np.ndarray, "voxels 3"]:
    """Return the mean of the points of each occupied voxel, in the order of the voxels.

    Arguments:
      points: Finite points, in metres.
      side_m: Side of a voxel, in metres.
    """
    voxel, counts = voxels(points, side_m)
    sums = [np.bincount(voxel, weights=axis, minlength=len(counts)) for axis in points.T]
    return np.stack(sums, axis=1) / counts[:, None]


def voxels(
    points: Float[np.ndarray, "n 3"], side_m: float
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " voxels"]]:
    """Return the number of the voxel of each point, and the number of points in each voxel."""
    cells = np.floor(points / side_m).astype(np.int64)
    _, voxel, counts = np.unique(cells @ [1 << 40, 1 << 20, 1], return_inverse=True, return_counts=True)
    return voxel, counts
