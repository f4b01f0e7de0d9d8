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
    """Return the range part of SOLiD, scaled to length 1. It does not change with rotations about z.

    The scan is reduced to voxel means (`VOXEL_M`), without points (metres, z up) nearer than 3 m or beyond 80 m. Each
    number is a weighted count of the means in a range of 2 m. The weight of an elevation, from 0 to 1, grows with the
    number of its means. Other elevations than -24.8 to 2 degrees count in the nearest bin. No points give zeros. The
    angular part of SOLiD, which estimates yaw, is left out.
    """
    distance = np.linalg.norm(points.astype(np.float64), axis=1)
    x, y, z = voxel_means(points[(distance >= NEAREST_M) & (distance <= FARTHEST_M)], VOXEL_M).T
    radius = np.hypot(x, y)
    elevation_share = (np.degrees(np.arctan2(z, radius)) - LOWEST_DEG) / (HIGHEST_DEG - LOWEST_DEG)
    row = np.minimum(radius / FARTHEST_M * RANGES, RANGES - 1).astype(np.int64)
    column = np.clip(np.floor(elevation_share * ELEVATIONS), 0, ELEVATIONS - 1).astype(np.int64)
    counts = np.bincount(row * ELEVATIONS + column, minlength=RANGES * ELEVATIONS).reshape(RANGES, ELEVATIONS)
    elevation_counts = counts.sum(axis=0).astype(np.float64)
    elevation_weights = (elevation_counts - elevation_counts.min()) / max(np.ptp(elevation_counts), 1)
    return unit_length((counts @ elevation_weights)[None])[0]
