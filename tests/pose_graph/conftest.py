"""Two laps of an ellipse by odometry that drifts, and the loops between them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sglpr_jax.loops.closure import LoopClosure
from sglpr_jax.se3 import inverse, transform

LAPS_FRAMES = 120
LOOP_COVARIANCE = np.diag([0.1, 0.1, 0.5, *np.radians([2, 2, 0.3])]) ** 2


@pytest.fixture(scope="session")
def two_laps() -> np.ndarray:
    """True poses on an ellipse that is driven around twice, up and down a hill."""
    angle = np.linspace(0, 4 * np.pi, LAPS_FRAMES)
    yaw = np.arctan2(60 * np.cos(angle), -90 * np.sin(angle))
    poses = np.stack([transform(90 * np.cos(a), 60 * np.sin(a), y) for a, y in zip(angle, yaw, strict=True)])
    poses[:, 2, 3] = 3 * np.sin(angle)
    return poses


@pytest.fixture(scope="session")
def two_laps_odometry(two_laps) -> np.ndarray:
    """1 % too long, turned by half a degree a frame, with noise."""
    rng = np.random.default_rng(0)
    steps = inverse(two_laps[:-1]) @ two_laps[1:]
    found = [two_laps[0]]
    for step in steps:
        noise = np.eye(4)
        noise[:3, :3] = Rotation.from_rotvec(np.radians([0, 0, 0.05]) + rng.normal(scale=1e-3, size=3)).as_matrix()
        noise[:3, 3] = 0.01 * step[:3, 3]
        found.append(found[-1] @ step @ noise)
    return np.stack(found)


@pytest.fixture(scope="session")
def second_lap_loops(two_laps) -> tuple[LoopClosure, ...]:
    """The second time around sees the first, to a decimetre."""
    rng = np.random.default_rng(1)
    found = []
    for query in range(64, LAPS_FRAMES, 4):
        match = int(np.linalg.norm(two_laps[:50, :3, 3] - two_laps[query, :3, 3], axis=1).argmin())
        pose = inverse(two_laps[match]) @ two_laps[query] @ transform(*rng.normal(scale=0.05, size=2), 0.002)
        found.append(LoopClosure(query, match, pose, LOOP_COVARIANCE, 0.99))
    return tuple(found)
