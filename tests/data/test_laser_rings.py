"""Rings: as the rays were cast, whichever way they are told; every 2nd and 4th is a half and a quarter of them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.data.corruption import keep_rings, ring_numbers
from sglpr_jax.data.formats.scan_files import read_scan, read_scan_records
from sglpr_jax.data.readers import open_recording
from sglpr_jax.sim.sensor import HDL64E_DEG


def turn(elevations_deg, *, azimuths=90, wobble_deg=0.0, seed=0):
    """Points of one turn, ring after ring from the highest, and the number of each point's ring from the lowest."""
    rng = np.random.default_rng(seed)
    elevation = np.radians(np.sort(elevations_deg)[::-1])[:, None]
    azimuth = (np.arange(azimuths) + 0.5)[None, :] * (2 * np.pi / azimuths)
    elevation = elevation + np.radians(wobble_deg) * np.sin(azimuth)
    distance = rng.uniform(3, 60, elevation.shape if wobble_deg else (len(elevation), azimuths))
    rays = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth]
    points = np.stack([distance * axis for axis in rays], axis=-1).reshape(-1, 3).astype(np.float32)
    return points, np.repeat(np.arange(len(elevation))[::-1], azimuths)


@pytest.mark.slow
@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(1, 64))
def test_elevations_that_stand_apart_tell_the_ring_in_any_order(seed, rings):
    points, expected = turn(HDL64E_DEG[:rings], seed=seed)
    order = np.random.default_rng(seed).permutation(len(points))
    np.testing.assert_array_equal(ring_numbers(points[order]), expected[order])


def test_rings_that_waver_are_told_by_the_order_of_the_points():
    points, expected = turn(HDL64E_DEG, wobble_deg=0.5)
    np.testing.assert_array_equal(ring_numbers(points), expected)
    some = np.random.default_rng(0).random(len(points)) < 0.7
    np.testing.assert_array_equal(ring_numbers(points[some]), expected[some])


def test_laser_numbers_of_the_file_come_first_whatever_their_order():
    points, expected = turn(HDL64E_DEG, wobble_deg=0.5)
    order = np.random.default_rng(0).permutation(len(points))
    names = np.random.default_rng(1).permutation(64) + 7
    found = ring_numbers(points[order], lasers=names[expected[order]])
    np.testing.assert_array_equal(found, expected[order])


def test_points_without_rings_are_refused():
    points = np.random.default_rng(0).normal(size=(5000, 3)).astype(np.float32)
    with pytest.raises(ValueError, match=r"expected a scan with rings .* found 5000 points without"):
        ring_numbers(points)
    shuffled = np.random.default_rng(0).permutation(turn(HDL64E_DEG, wobble_deg=0.5)[0])
    with pytest.raises(ValueError, match="expected a scan with rings"):
        ring_numbers(shuffled)


def test_no_points_have_no_rings():
    nothing = np.zeros((0, 3), np.float32)
    assert ring_numbers(nothing).shape == (0,) and keep_rings(ring_numbers(nothing), 16).shape == (0,)


@pytest.mark.parametrize(("found", "beams", "every"), [(64, 32, 2), (64, 16, 4), (61, 16, 4), (32, 16, 2), (16, 16, 1)])
def test_every_second_or_fourth_ring_is_kept(found, beams, every):
    rings = np.random.default_rng(0).permutation(np.repeat(np.arange(found), 5))
    kept = keep_rings(rings, beams)
    assert sorted(set(rings[kept])) == list(range(0, found, every))
    assert set(rings[~kept]) == set(range(found)) - set(range(0, found, every))


def test_real_scans_of_kitti_have_64_rings(shared):
    for path in sorted((shared / "data/kitti_odometry/sequences").glob("*/velodyne/*.bin")):
        rings = ring_numbers(read_scan(path))
        assert set(rings) == set(range(64)), path
        assert keep_rings(rings, 32).mean() == pytest.approx(0.5, abs=0.01)
        assert keep_rings(rings, 16).mean() == pytest.approx(0.25, abs=0.01)


def test_real_scans_of_other_sensors(shared):
    samples = shared / "data/samples"
    (nclt,) = (samples / "nclt/velodyne_sync").glob("*.bin")
    for path, expected in ((nclt, 32), (samples / "nuscenes_32_beams.pcd.bin", 32), (samples / "16_beams.pcd", 16)):
        points, lasers, _ = read_scan_records(path)
        finite = np.isfinite(points).all(axis=1)
        found = ring_numbers(points[finite], lasers=None if lasers is None else lasers[finite])
        assert set(found) == set(range(expected)), path


def test_a_folder_hands_on_the_lasers_of_its_files(tmp_path):
    np.array([[1, 2, 3, 0.5, 31]], dtype="<f4").tofile(tmp_path / "0.bin")
    np.testing.assert_array_equal(open_recording(tmp_path, format="nuscenes").record(0, lasers=True).lasers, [31])
