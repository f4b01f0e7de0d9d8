"""SOLiD (Kim et al., 2024): how many points lie at each range, those at busy elevations counting more."""

import numpy as np
from jaxtyping import Float32, Float64

from sglpr_jax.methods.method import HandcraftedMethod
from sglpr_jax.methods.unit_length import unit_length

RANGES = 40
ELEVATIONS = 32
LOWEST_DEG = -24.8
HIGHEST_DEG = 2.0
NEAREST_M = 3.0
FARTHEST_M = 80.0
VOXEL_M = 0.4


def solid(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "40"]:
    """Return R w, at unit length: the range part of SOLiD, which no rotation about z changes. No points give zeros.

    R (40 x 32) counts the points in ranges of 2 m, to 80 m, and elevations between -24.8 and 2 degrees; what is beyond
    counts for the nearest bin. w is the sum of R over the ranges, brought to 0 to 1: (n - min n) / (max n - min n).
    Points (metres, z up) nearer than 3 m or beyond 80 m in space are left out, and those of a voxel of 0.4 m are one,
    their mean. The 60 numbers of the angular part tell the yaw between two scans and take no part in the search, so
    they are not here.
    """
    near = np.linalg.norm(points.astype(np.float64), axis=1)
    x, y, z = _voxel_means(points[(near >= NEAREST_M) & (near <= FARTHEST_M)]).T
    radius = np.hypot(x, y)
    share = (np.degrees(np.arctan2(z, radius)) - LOWEST_DEG) / (HIGHEST_DEG - LOWEST_DEG)
    row = np.minimum(radius / FARTHEST_M * RANGES, RANGES - 1).astype(np.int64)
    column = np.clip(np.floor(share * ELEVATIONS), 0, ELEVATIONS - 1).astype(np.int64)
    counts = np.bincount(row * ELEVATIONS + column, minlength=RANGES * ELEVATIONS).reshape(RANGES, ELEVATIONS)
    number = counts.sum(axis=0).astype(np.float64)
    weights = (number - number.min()) / max(np.ptp(number), 1)
    return unit_length((counts @ weights)[None])[0]


def _voxel_means(points: Float32[np.ndarray, "n 3"]) -> Float64[np.ndarray, "voxels 3"]:
    """Return the mean of the points of each voxel that has any."""
    cells = np.floor(points / VOXEL_M).astype(np.int64)
    _, voxel, counts = np.unique(cells @ [1 << 40, 1 << 20, 1], return_inverse=True, return_counts=True)
    sums = [np.bincount(voxel, weights=axis, minlength=len(counts)) for axis in points.T]
    return np.stack(sums, axis=1) / counts[:, None]


SOLID = HandcraftedMethod(
    "solid",
    'Kim et al., "Narrowing your FOV with SOLiD", RA-L 2024',
    "points",
    solid,
)
