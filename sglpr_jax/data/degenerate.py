"""Clouds that show no place: nothing finite, everything at the sensor, coordinates that are no metres."""

import numpy as np
from jaxtyping import Float32

FARTHEST_M = 300.0
"""No LiDAR on a vehicle sees half of its points beyond this."""


def check_cloud(points: Float32[np.ndarray, "n 3"], *, name: str = "") -> None:
    """Raise ValueError, which begins with `name`, for a cloud (metres) that shows no place; says what was found."""
    where = f"{name}: " if name else ""
    finite = points[np.isfinite(points).all(axis=1)]
    if not len(finite):
        raise ValueError(f"{where}expected finite points, found none among {len(points)}")
    if not finite.any():
        raise ValueError(f"{where}expected points around the sensor, found all {len(finite)} of them at (0, 0, 0)")
    largest = np.abs(finite).max(axis=1)
    if np.median(largest) > FARTHEST_M:
        raise ValueError(
            f"{where}expected metres, most of them within {FARTHEST_M:g}, found half of the points beyond"
            f" {np.median(largest):.4g} and the farthest at {largest.max():.4g}; are these millimetres, or is the file"
            " read with a wrong --format?"
        )
