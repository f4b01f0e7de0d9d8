"""Scaled scans: odometry, settings and maps are in metres."""

import numpy as np

from sglpr_jax.data.scaled import scaled_poses
from sglpr_jax.loops.closure import LoopClosure, in_metres, scaled_drift
from sglpr_jax.loops.drift import deviations
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.se3 import transform

from .test_search import N, there_and_back

SCALE = 4


def test_odometry_drifts_as_much_at_any_scale():
    """Only the deviation of the comparison itself belongs to the images."""
    poses = scaled_poses(there_and_back(), 1 / SCALE)
    drift = DriftModel(degrees_per_metre=0.1, position_m=1e-3, height_m=1e-3)
    loops = [LoopClosure(2 * N - 1 - i, i, transform(0.1, 1.0, 3.0), 1e-9 * np.eye(6), 1.0) for i in range(0, N - 5, 5)]
    large = [in_metres(loop, 1) for loop in loops]
    for loop in large:
        loop.match_from_query[:3, 3] *= SCALE
    expected = deviations(loops, DrivenPath(poses), drift=drift)
    path = DrivenPath(scaled_poses(poses, float(SCALE)))
    found = deviations(large, path, drift=scaled_drift(drift, float(SCALE)))
    np.testing.assert_allclose(found, expected, rtol=0.02)
