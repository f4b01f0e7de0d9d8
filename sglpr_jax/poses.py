"""Positions, distances and rotations."""

import numpy as np
from jaxtyping import Bool, Float

ROTATION_TOLERANCE = 0.01
"""Tolerance for rotations in files with few digits."""


def positions_from_camera(world_from_camera: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "n 3"]:
    """Convert KITTI's camera poses (x right, y down, z forward) to positions (n, 3) in metres, z up.

    The camera's (x, y, z) becomes (z, -x, -y): x forward, y left, z up. The axes are only permuted, so distances in the
    camera's x and z are distances in x and y.
    """
    x, y, z = world_from_camera[:, :, 3].astype(np.float64).T
    return np.stack([z, -x, -y], axis=1)


def are_rotations(matrices: Float[np.ndarray, "*b 3 3"]) -> Bool[np.ndarray, "*b"]:
    """Whether each matrix R is a rotation: all entries of R R^T - I are below 0.01, and R is not a reflection."""
    with np.errstate(over="ignore", invalid="ignore"):
        apart = np.abs(matrices @ matrices.swapaxes(-1, -2) - np.eye(3)).max((-2, -1))
        return np.asarray((apart < ROTATION_TOLERANCE) & (np.linalg.det(matrices) > 0))


def distances(a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "n m"]:
    """Return the Euclidean distances in metres (float64) between every position of `a` and every position of `b`."""
    squared = np.zeros((len(a), len(b)))
    for a_axis, b_axis in zip(a.astype(np.float64).T, b.astype(np.float64).T, strict=True):
        squared += np.subtract.outer(a_axis, b_axis) ** 2
    return np.sqrt(squared)
