from collections.abc import Callable

import numpy as np
import pytest


@pytest.fixture(scope="session")
def places() -> list[tuple[np.ndarray, np.ndarray]]:
    """Return four places: points (n, 3) float32, metres, of ground, walls, poles and trunks, and their classes."""
    rng = np.random.default_rng(0)

    def place():
        ground = np.column_stack([rng.uniform(-45, 45, (1500, 2)), rng.normal(-1.7, 0.02, 1500)])
        parts, classes = [ground], [np.full(1500, 9)]
        for category, height, count in ((13, 7.0, 14), (16, 4.0, 10), (18, 5.0, 8), (19, 2.5, 4)):
            for _ in range(count):
                start = rng.uniform(-38, 38, 2)
                along = rng.normal(size=2) * (8.0 if category == 13 else 0.1)
                n = 150 if category == 13 else 60
                xy = start + rng.uniform(0, 1, (n, 1)) * along
                parts.append(np.column_stack([xy, rng.uniform(-1.7, height, n)]))
                classes.append(np.full(n, category))
        return np.concatenate(parts).astype(np.float32), np.concatenate(classes).astype(np.int32)

    return [place() for _ in range(4)]


@pytest.fixture(scope="session")
def wide() -> tuple[np.ndarray, np.ndarray]:
    """Return points beyond every limit, some on borders of cells, and their classes."""
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-95, 95, (2500, 2)), rng.uniform(-25, 25, 2500)])
    points[:, :2] *= rng.uniform(0, 1, (2500, 1))
    borders = [(4, 0, 1), (4.001, 1e-3, 1), (0, 80, -5), (10, -1e-3, 0), (30, 0, 0.5)]
    return np.concatenate([points, borders]).astype(np.float32), rng.integers(0, 20, 2505).astype(np.int32)


@pytest.fixture(scope="session")
def turn_points() -> Callable[[np.ndarray, float], np.ndarray]:
    """Return a function that turns points (n, 3) about z by radians, counter-clockwise."""

    def turn(points, angle):
        x, y, z = points.astype(np.float64).T
        planar = (x + 1j * y) * np.exp(1j * angle)
        return np.stack([planar.real, planar.imag, z], axis=1).astype(np.float32)

    return turn
