"""Clouds that show no place: nothing finite, everything at the sensor, coordinates that are no metres."""

import numpy as np
from jaxtyping import Float32

FARTHEST_M = 300.0
"""No LiDAR on a vehicle sees half of its points beyond this."""


def check_cloud(points: Float32[np.ndarray, "n _"], *, name: str = "") -> None:
    """Raise ValueError, which begins with `name`, for a cloud (metres) that shows no place; says what was found."""
    where = f"{name}: " if name else ""
    if points.shape[1] != 3:
        raise ValueError(f"{where}expected points of x, y and z alone, (n, 3), found an array of shape {points.shape}")
    x, y, z = np.abs(points.T)  # a column at a time: reductions along the three axes of a point take ten times as long
    largest = np.maximum(np.maximum(x, y), z)  # not finite where one of them is not
    near = largest <= FARTHEST_M
    if 2 * np.count_nonzero(near) > len(points) and (near & (largest > 0)).any():
        return  # of nearly all scans no more needs to be known
    largest = largest[np.isfinite(largest)]
    if not len(largest):
        raise ValueError(f"{where}expected finite points, found none among {len(points)}")
    if not largest.any():
        raise ValueError(f"{where}expected points around the sensor, found all {len(largest)} of them at (0, 0, 0)")
    half_are_beyond = 2 * np.count_nonzero(largest > FARTHEST_M) >= len(largest)
    if half_are_beyond and np.median(largest) > FARTHEST_M:
        raise ValueError(
            f"{where}expected metres, most of them within {FARTHEST_M:g}, found half of the points beyond"
            f" {np.median(largest):.4g} and the farthest at {largest.max():.4g}; are these millimetres, or is the file"
            " read with a wrong --format?"
        )
