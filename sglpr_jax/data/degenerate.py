"""Rejects point clouds that show no place: no finite points, all points at the sensor, or coordinates not in metres."""

import numpy as np
from jaxtyping import Float32

FARTHEST_M = 300.0
"""Limit of the largest coordinate of a point, in metres. No vehicle LiDAR has half of its points beyond it."""


def check_cloud(points: Float32[np.ndarray, "n _"], *, name: str = "") -> None:
    """Check that a point cloud shows a place.

    Arguments:
      points: Points in the sensor frame, in metres.
      name: Name of the scan for the error message.

    Raises:
      ValueError: If the array is not (n, 3), no point is finite, all points are at the sensor, or half of the points
        are beyond `FARTHEST_M`.
    """
    where = f"{name}: " if name else ""
    if points.shape[1] != 3:
        raise ValueError(f"{where}expected points (n, 3) with x, y and z only, found shape {points.shape}")
    x, y, z = np.abs(points.T)  # Column by column: a reduction over the last axis takes ten times as long.
    largest = np.maximum(np.maximum(x, y), z)  # Not finite if any coordinate is not finite.
    near = largest <= FARTHEST_M
    if 2 * np.count_nonzero(near) > len(points) and (near & (largest > 0)).any():
        return  # Nearly all scans end here.
    largest = largest[np.isfinite(largest)]
    if not len(largest):
        raise ValueError(f"{where}expected finite points, found none among {len(points)}")
    if not largest.any():
        raise ValueError(f"{where}expected points around the sensor, found all {len(largest)} points at (0, 0, 0)")
    half_are_beyond = 2 * np.count_nonzero(largest > FARTHEST_M) >= len(largest)
    if half_are_beyond and np.median(largest) > FARTHEST_M:
        raise ValueError(
            f"{where}expected metres, with most points within {FARTHEST_M:g}, found half of the points beyond"
            f" {np.median(largest):.4g} and the farthest at {largest.max():.4g}; are the coordinates in millimetres,"
            " or is the format of the scan wrong (--format, for .bin files)?"
        )
