"""Results of scaled scans are in metres."""

from pathlib import Path

import numpy as np
import pytest
from drives import loop_at
from recordings import of_scans

import sglpr_jax
from sglpr_jax.data.scaled import scaled_poses
from sglpr_jax.loops import search
from sglpr_jax.loops.closure import Loop, in_metres, scaled_drift
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.drift import deviations
from sglpr_jax.loops.search import Input
from sglpr_jax.maps.build import map_recording
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.odometry.config import DriftModel
from sglpr_jax.odometry.path import DrivenPath
from sglpr_jax.se3 import inverse, transform

from .test_search import CONFIG, N, searched

SCALE = 4


@pytest.fixture(scope="module")
def there_and_back() -> np.ndarray:
    """Poses along a bend and back beside it, 0.5 m apart."""
    there = np.stack([transform(5 * np.sin(a), 5 - 5 * np.cos(a), a) for a in np.arange(N) / 10])
    aside = np.stack([transform(0.0, 0.8 + 0.5 * np.sin(i), np.pi) for i in np.arange(N)])
    return np.concatenate([there, (there @ aside)[::-1]])


@pytest.mark.slow
def test_loops_of_scaled_scans_are_in_metres(params, compare_only, there_and_back, monkeypatch):
    large = scaled_poses(there_and_back, float(SCALE))
    detector = searched(params, compare_only, large, large)
    recording = of_scans({Path(f"{i}.bin"): np.zeros((1, 3), np.float32) for i in range(2 * N)})
    monkeypatch.setattr(search, "LoopDetector", lambda *_, **__: detector)
    found = search.find_loops(recording, params, odometry=there_and_back, config=CONFIG, registered=False, scale=SCALE)
    assert len(found.loops) >= N - 1 and str(found).endswith(", scale 4")
    for loop, one in zip(found.loops, sorted(detector.loops, key=lambda one: one.query), strict=False):
        true = inverse(there_and_back[loop.match]) @ there_and_back[loop.query]
        np.testing.assert_allclose(loop.match_from_query, true, atol=1e-6)
        np.testing.assert_allclose(loop.covariance[:3, :3], one.covariance[:3, :3] / SCALE**2)
        np.testing.assert_allclose(loop.covariance[3:, 3:], one.covariance[3:, 3:])
    np.testing.assert_array_equal(found.sessions[0].odometry, there_and_back)
    assert found.sessions[0].recording is recording and found.scale == SCALE
    assert found.config == CONFIG


def test_a_division_does_not_change_how_improbable_an_error_is():
    loop = loop_at(9, 2, transform(3.0, 1.0, 0.4), np.random.default_rng(0))
    half = in_metres(loop, 2)
    error = np.array([0.3, -0.2, 0.1, 0.01, 0.02, -0.03])
    small = error / [2, 2, 2, 1, 1, 1]
    assert error @ loop.information @ error == pytest.approx(small @ half.information @ small)


def test_odometry_drifts_as_much_at_any_scale(there_and_back):
    """Only the deviation of the comparison itself belongs to the images."""
    drift = DriftModel(degrees_per_metre=0.1, position_m=1e-3, height_m=1e-3)
    loops = [Loop(2 * N - 1 - i, i, transform(0.1, 1.0, 3.0), 1e-9 * np.eye(6), 1.0) for i in range(0, N - 5, 5)]
    large = [in_metres(loop, 1) for loop in loops]
    for loop in large:
        loop.match_from_query[:3, 3] *= SCALE
    expected = deviations(loops, DrivenPath(there_and_back), drift=drift)
    path = DrivenPath(scaled_poses(there_and_back, float(SCALE)))
    found = deviations(large, path, drift=scaled_drift(drift, float(SCALE)))
    np.testing.assert_allclose(found, expected, rtol=0.02)


def test_settings_of_the_user_are_real_metres():
    given = Input(of_scans({}), np.eye(4)[None], DetectorConfig(keyframe_m=0.5))
    found = given.scaled(2).config
    assert found.keyframe_m == 1.0 and found.candidates == given.config.candidates
    assert given.scaled(1).config == given.config


def test_scans_are_located_in_a_map_of_their_scale(params, tmp_path):
    """A hall of 12 m with a few things: each place finds itself, and scale and metres come back from the file."""
    rng = np.random.default_rng(3)
    things = rng.uniform([-2, -6], [10, 6], (25, 2))
    xy = np.repeat(things, 60, axis=0) + rng.normal(0, 0.06, (1500, 2))
    world = np.column_stack([xy, rng.uniform(0.2, 1.5, 1500)])
    poses = np.stack([transform(float(x), 0.0, 0.0) for x in (0.0, 2.0, 4.0)])
    poses[:, 2, 3] = 0.5
    scans = {Path(f"{i}.bin"): (world - pose[:3, 3]).astype(np.float32) for i, pose in enumerate(poses)}
    recording = of_scans(scans, mounting=sglpr_jax.Mounting(0.5))
    made = map_recording(recording, params, poses, spacing_m=0.0, scale=SCALE).places
    made.save(tmp_path / "hall.safetensors")
    places = PlaceMap.load(tmp_path / "hall.safetensors")
    assert places.scale == SCALE and places.mounting().height_m == 0.5
    query = transform(2.3, 0.2, 0.0)
    query[2, 3] = 0.5
    best = places.relocate(params, (world - query[:3, 3]).astype(np.float32))[0]
    assert best.place.endswith("/1")
    np.testing.assert_allclose(best.world_from_query, query, atol=0.06)
    np.testing.assert_allclose(best.loop.match_from_query[:3, 3], [0.3, 0.2, 0.0], atol=0.06)
    with pytest.raises(ValueError, match="expected scale 4, found scale 1: descriptors of scans with different scales"):
        places.merged(map_recording(recording, params, poses, spacing_m=0.0).places)
