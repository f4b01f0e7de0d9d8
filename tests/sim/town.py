"""Trajectories for tests of the town: corners joined by straight lines and quarter circles."""

import numpy as np

from sglpr_jax.se3 import lengths_along

RADIUS_M = 7.0
LOOP = ((0, 0), (160, 0), (160, 90), (0, 90), (0, 0), (110, 0))
"""Around a block and on along the first street: 610 m, the last 110 m in the same direction as the first."""
THERE_AND_BACK = ((0, 0), (150, 0), (150, 80), (230, 80), (230, 2.4), (0, 2.4))
"""Around a block and back along the first street, 2.4 m left of the first pass: the other lane."""


def drive(corners, *, speed: float = 8.0, spacing: float = 0.8) -> tuple[np.ndarray, np.ndarray]:
    """Trajectory (n, 2) and times (n,) of a drive at a constant speed past `corners`."""
    corners = np.array(corners, float)
    pieces = [corners[:1]]
    for before, corner, after in zip(corners[:-2], corners[1:-1], corners[2:], strict=True):
        arriving, leaving = ((b - a) / np.linalg.norm(b - a) for a, b in ((before, corner), (corner, after)))
        share = np.linspace(0, np.pi / 2, 20)[:, None]
        pieces.append(corner + RADIUS_M * ((1 - np.cos(share)) * leaving - (1 - np.sin(share)) * arriving))
    line = np.concatenate([*pieces, corners[-1:]])
    travelled = lengths_along(line)
    at = np.arange(0, travelled[-1], spacing)
    return np.stack([np.interp(at, travelled, axis) for axis in line.T], axis=1), at / speed
