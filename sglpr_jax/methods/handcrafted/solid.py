"""SOLiD (Kim et al., 2024): number of points at each range. Elevations with more points have a higher weight."""

import numpy as np
from jaxtyping import Float32

from sglpr_jax.methods.cells import voxel_means
from sglpr_jax.methods.pairwise import unit_length

RANGES = 40
ELEVATIONS = 32
LOWEST_DEG = -24.8
HIGHEST_DEG = 2.0
NEAREST_M = 3.0
FARTHEST_M = 80.0
VOXEL_M = 0.4


def solid(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "40"]:
    """Return R w with length 1: the range part of SOLiD, which is invariant to rotation about z. No points give zeros.

    R (40 x 32) counts the points in ranges of 2 m, up to 80 m, and in elevations between -24.8 and 2 degrees. Points
    outside these limits count in the nearest bin. w is the sum n of R over the ranges, scaled to 0 to 1: (n - min n) /
    (max n - min n). Points (metres, z up) nearer than 3 m or beyond 80 m are ignored, and the mean of each voxel of 0.4
    m replaces its points. The 60 numbers of the angular part estimate yaw and are left out.
    """
    near = np.linalg.norm(points.astype(np.float64), axis=1)
    x, y, z = voxel_means(points[(near >= NEAREST_M) & (near <= FARTHEST_M)], VOXEL_M).T
    radius = np.hypot(x, y)
    share = (np.degrees(np.arctan2(z, radius)) - LOWEST_DEG) / (HIGHEST_DEG - LOWEST_DEG)
    row = np.minimum(radius / FARTHEST_M * RANGES, RANGES - 1).astype(np.int64)
    column = np.clip(np.floor(share * ELEVATIONS), 0, ELEVATIONS - 1).astype(np.int64)
    counts = np.bincount(row * ELEVATIONS + column, minlength=RANGES * ELEVATIONS).reshape(RANGES, ELEVATIONS)
    number = counts.sum(axis=0).astype(np.float64)
    weights = (number - number.min()) / max(np.ptp(number), 1)
    return unit_length((counts @ weights)[None])[0]
