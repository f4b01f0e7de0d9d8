"""Density images in the format of BEVPlace's KITTI images (8-bit PNG).

A scan is reduced to one centroid per voxel. A pixel thus measures how much of its column is occupied, regardless of
its distance to the sensor. The rows of the image point against x (forward), and its columns against y (left).
`density_bev` returns the image in the orientation of equation 1, on the scale of counts.
"""

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8

from sglpr_jax.grid import DENSITY_MAX_COUNT, DENSITY_RESOLUTION_M, DENSITY_SIZE

REACH_M = 25.0
"""Maximum |x| and |y| of a point, in metres."""
FLOOR_M = -1.2
"""Minimum height of a point above the sensor, in metres. It is about 0.5 m above the road."""
CEILING_M = 200.0
"""Maximum height of a point above the sensor, in metres. No scan reaches this height. The limit keeps voxel numbers
within 32 bits."""
MAX_VOXELS = 6000
"""Maximum number of voxels of a scan."""
MOST_SPREAD = 2**25
"""Maximum range of voxel numbers for marking them in an array instead of sorting them. A usual range is 2**24. A point
30 m above the sensor increases it to 10**8."""
SAMPLE_POINTS, SAMPLE_VOXELS = 18_000, 2**16
"""Number of points in the sample for a lower bound of the number of voxels, and the modulus of its voxel numbers."""
FIRST_EDGE_M, EDGE_STEP_M = 0.10, 0.05
"""Smallest voxel edge and its increment, in metres."""


def density_bev(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "151 151"]:
    """Compute the density image of a scan in the orientation of equation 1, as counts from 0 to 10 in cells of 0.4 m.

    The result equals writing `density_image` to a PNG and reading it as a ready-made image.
    """
    return as_counts(np.rot90(density_image(points), -1))


def as_counts(grey: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Scale grey values 0..255 to counts 0..10."""
    return np.ascontiguousarray(grey) * np.float32(DENSITY_MAX_COUNT / 255)


def density_image(points: Float32[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "151 151"]:
    """Compute the density image of a scan: voxel centroids per cell, capped at 10 and scaled to a maximum of 255.

    The edge of the voxels is the smallest of 0.10, 0.15, 0.20, ... m that gives at most 6000 voxels. Points that are
    not finite are dropped. The result equals KITTI's ready-made images pixel for pixel.
    """
    cropped = points.T.take(np.flatnonzero(_is_in_crop(points)), axis=1)
    cells = _cell_of_point(_voxel_centroids(cropped))
    counts = np.bincount(cells, minlength=DENSITY_SIZE**2).clip(max=DENSITY_MAX_COUNT)
    return np.round(counts * (255 / max(counts.max(), 1))).astype(np.uint8).reshape(DENSITY_SIZE, DENSITY_SIZE)


def density_label_image(
    points: Float32[np.ndarray, "n 3"], classes: Int[np.ndarray, " n"]
) -> Int32[np.ndarray, "151 151"]:
    """Compute the class of the last point in each cell of the density image, or 0 for cells without points.

    A label belongs to the cell of its point, but a count belongs to the cell of the voxel's centroid. At the edges of
    objects, a cell may therefore have one without the other.
    """
    in_crop = _is_in_crop(points)
    labels = np.zeros(DENSITY_SIZE**2, np.int32)
    labels[_cell_of_point(points[in_crop].T)] = classes[in_crop]  # NumPy keeps the last of repeated assignments.
    return labels.reshape(DENSITY_SIZE, DENSITY_SIZE)


def values_of_points(image: Int[np.ndarray, "151 151"], points: Float32[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Return the value of each point's cell in an image aligned with `density_image`, and 0 outside the crop."""
    in_crop = _is_in_crop(points)
    values = np.zeros(len(points), image.dtype)
    values[in_crop] = image.reshape(-1)[_cell_of_point(points[in_crop].T)]
    return values


def _is_in_crop(points: Float32[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Whether each point counts in a density image: it is finite, within 25 m in x and y, and above the road."""
    x, y, z = points.T
    return (np.abs(x) < REACH_M) & (np.abs(y) < REACH_M) & (z > FLOOR_M) & (z < CEILING_M)


def _cell_of_point(points: Float[np.ndarray, "_ n"]) -> Int[np.ndarray, " n"]:
    """Return the flat cell index of each point (column). Truncation makes the middle row and column two cells wide."""
    row, column = DENSITY_SIZE // 2 - np.trunc(points[:2] / DENSITY_RESOLUTION_M).astype(np.int64)
    return row * DENSITY_SIZE + column


def _voxel_centroids(points: Float32[np.ndarray, "3 n"]) -> Float[np.ndarray, "2 v"]:
    """Return x and y of the mean point of each voxel, in metres, for the smallest edge with at most `MAX_VOXELS`."""
    voxels, distinct = _voxels_at_smallest_edge(points)
    if not len(distinct):
        return np.zeros((2, 0))
    least, spread = distinct[0], int(distinct[-1]) - int(distinct[0]) + 1
    if spread > MOST_SPREAD:
        voxel = np.searchsorted(distinct, voxels)
    else:
        rank = np.empty(spread, np.int32)  # of each voxel among the distinct ones; only these elements are written
        rank[distinct - least] = np.arange(len(distinct))
        voxel = rank[voxels - least]
    return np.stack([np.bincount(voxel, weights=axis) for axis in points[:2]]) / np.bincount(voxel)


def _voxels_at_smallest_edge(
    points: Float32[np.ndarray, "3 n"],
) -> tuple[Int32[np.ndarray, " n"], Int[np.ndarray, " v"]]:
    """Return the voxel number of each point for the smallest edge with at most `MAX_VOXELS` voxels, and `_distinct`."""
    sample = np.ascontiguousarray(points[:, :: max(1, points.shape[1] // SAMPLE_POINTS)])
    edge_m = FIRST_EDGE_M
    while True:
        # The count of a sample, with numbers modulo 2**16, is quick and never above the count of all points.
        if len(_distinct(_voxel_of_point(sample, edge_m) & (SAMPLE_VOXELS - 1))) <= MAX_VOXELS:
            voxels = _voxel_of_point(points, edge_m)
            distinct = _distinct(voxels)
            if len(distinct) <= MAX_VOXELS:
                return voxels, distinct
        edge_m += EDGE_STEP_M


def _distinct(voxels: Int32[np.ndarray, " n"]) -> Int[np.ndarray, " v"]:
    """Return the different voxel numbers in ascending order."""
    if not len(voxels):
        return voxels
    least = int(voxels.min())
    spread = int(voxels.max()) - least + 1
    if spread > MOST_SPREAD:
        return np.unique(voxels)
    is_occupied = np.zeros(spread, bool)
    is_occupied[voxels - least] = True
    return np.flatnonzero(is_occupied) + least


def _voxel_of_point(points: Float32[np.ndarray, "3 n"], edge_m: float) -> Int32[np.ndarray, " n"]:
    """Return the voxel of each point as one number. Voxel corners are at multiples of `edge_m`."""
    x, y, z = np.floor(points * np.float32(1 / edge_m)).astype(np.int32)
    side = 2 * int(REACH_M / edge_m) + 4  # The margin allows for rounding.
    return (z * side + y) * side + x
