"""The image domain of BEVPlace's KITTI images: a scan as the 8-bit density image that stands in such a dataset.

A scan is thinned to one centroid for each voxel, so that a pixel tells how much of its column is occupied and not how
near the sensor is. The rows of the image run against x (forward), its columns against y (left); `density_bev` is the
image as `bev_images.read_image` reads it, in the orientation of eq. 1 and on the scale of counts.
"""

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, Num, UInt8

from sglpr_jax.data.density_grid import MAX_COUNT, RESOLUTION_M, SIZE
from sglpr_jax.data.readers.bev_images import as_counts

REACH_M = 25.0
"""Points count where |x| and |y| are below this."""
FLOOR_M = -1.2
"""Points count above this height over the sensor: some 0.5 m over the road."""
CEILING_M = 200.0
"""Points count below this height, which no scan reaches, so that the number of a voxel fits 32 bits."""
MAX_VOXELS = 6000
MOST_SPREAD = 2**25
"""Voxels whose numbers are farther apart are counted by sorting them; 2**24 is usual, a point 30 m up makes 10**8."""
SOME_POINTS, SOME_VOXELS = 18_000, 2**16
"""A quick count sees every n-th point, but at least so many, and voxels whose numbers differ by so many as one."""
EDGE_STEP_M = 0.05
FIRST_EDGE_M = 0.10
BEYOND_COUNTS = 2.0
"""An image that was resized smoothly has counts a little below 0 or above 10; what is farther off is no count."""


def density_bev(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "151 151"]:
    """The density image of a scan (metres, LiDAR frame) in the orientation of eq. 1, as counts 0..10 in cells of 0.4 m.

    Equal to writing `density_image` as a PNG and reading that as a ready-made image.
    """
    return as_counts(np.rot90(density_image(points), -1))


def density_label_bev(
    points: Float32[np.ndarray, "n 3"], classes: Int[np.ndarray, " n"]
) -> Int32[np.ndarray, "151 151"]:
    """The map of classes that lies on `density_bev`; see `density_label_image`."""
    return np.ascontiguousarray(np.rot90(density_label_image(points, classes), -1))


def check_density_counts(image: Num[np.ndarray, "h w"], *, name: str) -> None:
    """Raise ValueError, which begins with `name`, for floats that are no counts 0 to 10: grey values, counts of points.

    To a model they would be a place like any other.
    """
    least, most = image.min(initial=0), image.max(initial=0)
    within = least >= -BEYOND_COUNTS and most <= MAX_COUNT + BEYOND_COUNTS  # NaN is not
    if np.issubdtype(image.dtype, np.floating) and not within:
        raise ValueError(
            f"{name}: expected a density image, floats from 0 to {MAX_COUNT}, found floats from {least:g} to {most:g};"
            f" are these grey values, of which 255 stands for {MAX_COUNT}, or counts of points?"
        )


def density_image(points: Float32[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "151 151"]:
    """The density image of a scan (metres, LiDAR frame): voxel centroids per cell, capped at 10, the fullest cell 255.

    The voxels' edge is the smallest of 0.10, 0.15, 0.20, ... m that leaves at most 6000 voxels. Points that are not
    finite are dropped. Pixel for pixel what the ready-made images of KITTI show.
    """
    centroids = _voxel_centroids(points.T.take(np.flatnonzero(_in_crop(points)), axis=1))
    counts = np.bincount(_cell_of_point(centroids), minlength=SIZE**2).clip(max=MAX_COUNT)
    return np.round(counts * (255 / max(counts.max(), 1))).astype(np.uint8).reshape(SIZE, SIZE)


def density_label_image(
    points: Float32[np.ndarray, "n 3"], classes: Int[np.ndarray, " n"]
) -> Int32[np.ndarray, "151 151"]:
    """The class of the last point that falls into each cell of the scan's density image, 0 where none does.

    Only points of the image's crop count. A cell is that of the point itself and not of its voxel's centroid, so at
    the rims of things a label may stand beside a pixel that is 0, and the other way round.
    """
    counted = _in_crop(points)
    labels = np.zeros(SIZE**2, np.int32)
    labels[_cell_of_point(points[counted].T)] = classes[counted]  # numpy keeps the last of repeated assignments
    return labels.reshape(SIZE, SIZE)


def _in_crop(points: Float32[np.ndarray, "n 3"]) -> np.ndarray:
    x, y, z = points.T
    return (np.abs(x) < REACH_M) & (np.abs(y) < REACH_M) & (z > FLOOR_M) & (z < CEILING_M)


def _cell_of_point(points: Float[np.ndarray, "_ n"]) -> Int[np.ndarray, " n"]:
    """The flat cell of every point. Truncation makes the row and the column through the sensor two cells wide."""
    row, column = SIZE // 2 - np.trunc(points[:2] / RESOLUTION_M).astype(np.int64)
    return row * SIZE + column


def _voxel_centroids(points: Float32[np.ndarray, "3 n"]) -> Float[np.ndarray, "2 v"]:
    """The mean x and y of the points in each voxel, with the smallest edge that leaves few enough voxels."""
    voxels = _fewest_voxels(points)
    if not len(voxels):
        return np.zeros((2, 0))
    voxel = _numbered(voxels)
    return np.stack([np.bincount(voxel, weights=axis) for axis in points[:2]]) / np.bincount(voxel)


def _fewest_voxels(points: Float32[np.ndarray, "3 n"]) -> Int32[np.ndarray, " n"]:
    """The voxel of every point, for the smallest edge with which there are at most `MAX_VOXELS` of them.

    Most edges are ruled out by the quick count, which never finds more voxels than there are.
    """
    some = np.ascontiguousarray(points[:, :: max(1, points.shape[1] // SOME_POINTS)])
    edge_m = FIRST_EDGE_M
    while _too_many(_voxel_of_point(some, edge_m) & (SOME_VOXELS - 1)) or _too_many(
        voxels := _voxel_of_point(points, edge_m)
    ):
        edge_m += EDGE_STEP_M
    return voxels


def _too_many(voxels: Int32[np.ndarray, " n"]) -> bool:
    found = _found(voxels)
    return int(len(np.unique(voxels)) if found is None else np.count_nonzero(found)) > MAX_VOXELS


def _numbered(voxels: Int32[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """The voxels numbered without gaps, in their order."""
    found = _found(voxels)
    if found is None:
        return np.unique(voxels, return_inverse=True)[1]
    return (np.cumsum(found) - 1)[voxels - voxels.min()]


def _found(numbers: Int32[np.ndarray, " n"]) -> Bool[np.ndarray, " m"] | None:
    """Of the numbers from the smallest to the largest, which are there: faster than to sort them, as np.unique does.

    None where a point high in the air spreads them so far that it would not be.
    """
    if not len(numbers):
        return np.zeros(0, bool)
    least = int(numbers.min())
    spread = int(numbers.max()) - least + 1
    if spread > MOST_SPREAD:
        return None
    found = np.zeros(spread, bool)
    found[numbers - least] = True
    return found


def _voxel_of_point(points: Float32[np.ndarray, "3 n"], edge_m: float) -> Int32[np.ndarray, " n"]:
    """The voxel of every point as one number; the voxels' corners are multiples of `edge_m`."""
    x, y, z = np.floor(points * np.float32(1 / edge_m)).astype(np.int32)
    side = 2 * int(REACH_M / edge_m) + 4  # with room for rounding
    return (z * side + y) * side + x
