"""A small place of walls and poles, seen from anywhere."""

import numpy as np

from sglpr_jax.bev import rasterize
from sglpr_jax.grid import Grid

GRID = Grid(resolution_m=0.4, height=64, width=64)


def place(seed: int = 0) -> np.ndarray:
    """Points (n, 2) of walls and poles about the origin, metres."""
    rng = np.random.default_rng(seed)
    parts = []
    for _ in range(14):
        start, heading, length = rng.uniform(-14, 14, 2), rng.choice([0.3, 0.3 + np.pi / 2]), rng.uniform(2, 9)
        along = rng.uniform(0, length, 300)
        parts.append(start + along[:, None] * [np.cos(heading), np.sin(heading)])
    poles = rng.uniform(-14, 14, (12, 2))
    parts.append(np.repeat(poles, 40, axis=0) + rng.normal(scale=0.08, size=(480, 2)))
    return np.concatenate(parts)


def seen_from(points: np.ndarray, pose: tuple[float, float, float], *, grid: Grid = GRID, seed: int = 0) -> np.ndarray:
    """The image of a place from the pose (x, y, yaw), with 3 cm of noise, as counts up to 10."""
    x, y, yaw = pose
    cos, sin = np.cos(yaw), np.sin(yaw)
    local = (points - [x, y]) @ np.array([[cos, -sin], [sin, cos]])
    local += np.random.default_rng(seed).normal(scale=0.03, size=local.shape)
    cloud = np.pad(local, ((0, 0), (0, 1))).astype(np.float32)
    return np.minimum(np.asarray(rasterize(cloud, grid=grid)), 10).astype(np.float32)


def relative(match: tuple[float, float, float], query: tuple[float, float, float]) -> np.ndarray:
    """The pose of the query in the match's frame, (x, y, yaw)."""
    cos, sin = np.cos(match[2]), np.sin(match[2])
    dx, dy = query[0] - match[0], query[1] - match[1]
    return np.array([cos * dx + sin * dy, cos * dy - sin * dx, query[2] - match[2]])


def difference(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Of two poses (x, y, yaw), the angle from -pi to pi."""
    apart = np.asarray(found, np.float64) - expected
    apart[2] = (apart[2] + np.pi) % (2 * np.pi) - np.pi
    return apart
