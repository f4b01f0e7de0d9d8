"""Points in cells, for several methods: polar coordinates, extreme values of cells, and voxels."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int64


def polar(points: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "3 n"]:
    """Return the horizontal range, the azimuth in radians from -pi to pi, and the height of each point."""
    x, y, z = points.astype(np.float64).T
    return np.stack([np.hypot(x, y), np.arctan2(y, x), z])


def extreme_of_cells(
    extreme: np.ufunc, shape: Sequence[int], cells: Any, values: Float[np.ndarray, " n"]
) -> Float64[np.ndarray, "..."]:
    """Return an image with the largest or the smallest of the values in each cell, and 0 in empty cells.

    Arguments:
      extreme: `np.maximum` or `np.minimum`.
      shape: Shape of the image.
      cells: Cell of each value, as an index of the image: an array (n,), or one array for each axis.
      values: Finite values.
    """
    image = np.full(shape, np.inf if extreme is np.minimum else -np.inf)
    extreme.at(image, cells, values)
    return np.where(np.isfinite(image), image, 0)


def voxel_means(points: Float[np.ndarray, "n 3"], side_m: float) -> Float64[np.ndarray, "voxels 3"]:
    """Return the mean of the points, which must be finite, in each occupied voxel, sorted by the voxels' x, y and z."""
    voxel, counts = group_by_voxel(points, side_m)
    return group_means(points, voxel, counts)


def group_by_voxel(
    points: Float[np.ndarray, "n 3"], side_m: float
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " voxels"]]:
    """Return the index of each point's voxel among the occupied voxels, and the number of points in each of these."""
    voxels = np.floor(points / side_m).astype(np.int64)
    voxel_keys = voxels @ [1 << 40, 1 << 20, 1]  # unique and sorted by x, y, z for up to 2**20 voxels along an axis
    _, voxel, counts = np.unique(voxel_keys, return_inverse=True, return_counts=True)
    return voxel, counts


def group_means(
    points: Float[np.ndarray, "n 3"], group: Int64[np.ndarray, " n"], counts: Int64[np.ndarray, " groups"]
) -> Float64[np.ndarray, "groups 3"]:
    """Return the mean of the points of each group, given the group of each point and the sizes of the groups."""
    sums = [np.bincount(group, weights=coordinate, minlength=len(counts)) for coordinate in points.T]
    return np.stack(sums, axis=1) / counts[:, None]
