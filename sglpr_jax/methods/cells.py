"""Cells of a scan: polar coordinates, extreme values in cells, and voxels."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int64


def polar(points: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "3 n"]:
    """Return the horizontal range, the azimuth in radians from -pi to pi, and the height of each point."""
    x, y, z = points.astype(np.float64).T
    return np.stack([np.hypot(x, y), np.arctan2(y, x), z])


def extreme(
    choose: np.ufunc, shape: Sequence[int], at: Any, values: Float[np.ndarray, " n"]
) -> Float64[np.ndarray, "..."]:
    """Return the largest (`np.maximum`) or the smallest value (`np.minimum`) of each cell, 0 in empty cells.

    Arguments:
      choose: Function of two values.
      shape: Numbers of cells along the axes.
      at: Index of each value in the image.
      values: Finite values.
    """
    image = np.full(shape, np.inf if choose is np.minimum else -np.inf)
    choose.at(image, at, values)
    return np.where(np.isfinite(image), image, 0)


def voxel_means(points: Float[np.ndarray, "n 3"], side_m: float) -> Float64[np.ndarray, "voxels 3"]:
    """Return the mean of the finite points of each occupied voxel, in the order of the voxels."""
    return means(points, *voxels(points, side_m))


def voxels(
    points: Float[np.ndarray, "n 3"], side_m: float
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " voxels"]]:
    """Return the number of the voxel of each point, and the number of points in each voxel."""
    cells = np.floor(points / side_m).astype(np.int64)
    _, voxel, counts = np.unique(cells @ [1 << 40, 1 << 20, 1], return_inverse=True, return_counts=True)
    return voxel, counts


def means(
    points: Float[np.ndarray, "n 3"], group: Int64[np.ndarray, " n"], counts: Int64[np.ndarray, " groups"]
) -> Float64[np.ndarray, "groups 3"]:
    """Return the mean of the points of each group, given the group of each point and the sizes of the groups."""
    sums = [np.bincount(group, weights=axis, minlength=len(counts)) for axis in points.T]
    return np.stack(sums, axis=1) / counts[:, None]
