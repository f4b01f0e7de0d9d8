"""Scaled scans: odometry, settings and maps are in metres."""

import numpy as np
import pytest
from drives import loop_at
from recordings import of_scans

from sglpr_jax.data.scaled import scaled_poses
from sglpr_jax.loops.closure import Loop, in_metres, scaled_drift
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.drift import deviations
from sglpr_jax.loops.search import Input
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.se3 import transform

from .test_search import N, there_and_back

SCALE = 4


def test_a_division_does_not_change_how_improbable_an_error_is():
    loop = loop_at(9, 2, transform(3.0, 1.0, 0.4), np.random.default_rng(0))
    half = in_metres(loop, 2)
    error = np.array([0.3, -0.2, 0.1, 0.01, 0.02, -0.03])
    small = error / [2, 2, 2, 1, 1, 1]
    assert error @ loop.information @ error == pytest.approx(small @ half.information @ small)


def test_odometry_drifts_as_much_at_any_scale():
    """Only the deviation of the comparison itself belongs to the images."""
    poses = scaled_poses(there_and_back(), 1 / SCALE)
    drift = DriftModel(degrees_per_metre=0.1, position_m=1e-3, height_m=1e-3)
    loops = [Loop(2 * N - 1 - i, i, transform(0.1, 1.0, 3.0), 1e-9 * np.eye(6), 1.0) for i in range(0, N - 5, 5)]
    large = [in_metres(loop, 1) for loop in loops]
    for loop in large:
        loop.match_from_query[:3, 3] *= SCALE
    expected = deviations(loops, DrivenPath(poses), drift=drift)
    path = DrivenPath(scaled_poses(poses, float(SCALE)))
    found = deviations(large, path, drift=scaled_drift(drift, float(SCALE)))
    np.testing.assert_allclose(found, expected, rtol=0.02)


def test_settings_of_the_user_are_real_metres():
    given = Input(of_scans({}), np.eye(4)[None], DetectorConfig(keyframe_m=0.5))
    found = given.scaled(2).config
    assert found.keyframe_m == 1.0 and found.candidates == given.config.candidates
    assert given.scaled(1).config == given.config
