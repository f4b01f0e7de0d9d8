"""Gravity of each scan of a sensor that tilts: from the ground, filtered over scans, averaged with odometry."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from clouds import street
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import of_scans
from scipy.spatial.transform import Rotation

import sglpr_jax
from sglpr_jax.data.gravity import GROUND_TILT_DEG, ODOMETRY_TILT_DEG, GroundFilter, mounted, with_odometry
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.scan_stream import only
from sglpr_jax.files import DataWarning

SCANS = 30


def swinging(degrees: float, *, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rotation of each scan of a sensor that swings by some degrees, and its height in metres."""
    rng = np.random.default_rng(seed)
    pitch, roll = degrees * np.sin(np.arange(SCANS)[:, None] * [1.7, 0.9] + rng.uniform(0, 6, 2)).T
    turned = Rotation.from_euler("zyx", np.stack([np.arange(SCANS) * 3.0, pitch, roll], axis=1), degrees=True)
    return turned.as_matrix(), 1.4 + 0.04 * np.sin(np.arange(SCANS))


def recording_of(turned: np.ndarray, heights: np.ndarray, *, blind: tuple[int, ...] = ()):
    """A recording of a street, without ground in the scans `blind`."""
    clouds = {}
    for i, (turn, height) in enumerate(zip(turned, heights, strict=True)):
        cloud = street(i, height_m=height)
        cloud = cloud[cloud[:, 2] > 0.5] if i in blind else cloud
        clouds[Path(f"{i:06d}.bin")] = (cloud @ turn).astype(np.float32)
    return of_scans(clouds)


def angles_deg(mountings, turned) -> np.ndarray:
    """Angle between up of each mounting and true up."""
    ups = np.array([one.up for one in mountings])
    return np.degrees(np.arccos(np.clip((ups * turned[:, 2]).sum(axis=1), -1, 1)))


@pytest.fixture(scope="module")
def hand():
    turned, heights = swinging(12.0)
    return recording_of(turned, heights, blind=(7,)), turned, heights


@pytest.fixture(scope="module")
def opened(hand):
    return mounted(hand[0], "auto", known=False)


def test_each_scan_of_a_hand_has_its_own_mounting(hand, opened):
    _, turned, heights = hand
    seen = np.arange(SCANS) != 7
    assert angles_deg(opened.mountings, turned)[seen].max() < 1
    np.testing.assert_allclose([one.height_m for one in opened.mountings], heights, atol=0.1)
    assert opened.mountings[7].tilt_deviation_deg > 4 > 2 * GROUND_TILT_DEG > opened.mountings[8].tilt_deviation_deg
    assert opened.found[-1].startswith("gravity: the sensor tilts by ") and "in 29 of 30 scans" in opened.found[-1]
    assert opened.scan(3).mounting == opened.mountings[3]
    assert only(opened, [4, 6]).mountings == (opened.mountings[4], opened.mountings[6])


def test_gravity_of_one_or_of_all_scans_can_be_chosen(hand, opened):
    assert mounted(hand[0], "auto", gravity="recording", known=False).mountings is None
    with pytest.warns(DataWarning, match="as its layout defines"):
        assert mounted(hand[0], "auto", known=True).mountings is None
    assert mounted(hand[0], 1.4, known=False).mountings is None
    forced = mounted(hand[0], 1.4, gravity="scan", known=False)
    np.testing.assert_allclose([one.up for one in forced.mountings], [one.up for one in opened.mountings], atol=0.02)


def test_a_vehicle_keeps_one_mounting():
    recording = recording_of(*swinging(1.5))
    found = mounted(recording, "auto", known=False)
    assert found.mountings is None and found.found[-1].startswith("sensor: 1.4")
    assert found.scan(3).mounting is found.mounting


def test_odometry_averages_gravity_over_the_path_and_keeps_the_height(hand, opened):
    _, turned, _ = hand
    poses = np.tile(np.eye(4), (SCANS, 1, 1))
    world = Rotation.from_euler("xyz", [20, -10, 40], degrees=True).as_matrix()
    poses[:, :3, :3], poses[:, 0, 3] = world @ turned, np.arange(SCANS)
    found = with_odometry(opened, poses)
    assert angles_deg(found.mountings, turned).max() < 0.5  # the scan without ground, too
    assert {one.tilt_deviation_deg for one in found.mountings} == {ODOMETRY_TILT_DEG}
    assert [one.height_m for one in found.mountings] == [one.height_m for one in opened.mountings]
    poses[:, :3, :3] = np.eye(3)
    flat = with_odometry(opened, poses)
    assert flat.mountings == opened.mountings and "does not show the tilt" in flat.found[-1]
    fixed = dataclasses.replace(opened, mountings=None)
    assert with_odometry(fixed, poses) is fixed


@settings(max_examples=30, deadline=None)
@given(st.floats(-12, 12), st.floats(-12, 12), st.floats(25, 60))
def test_one_bad_scan_does_not_tilt_an_image(pitch, roll, off):
    def ground(*degrees):
        return Mounting(1.4, tuple(Rotation.from_euler("yx", degrees, degrees=True).as_matrix()[2].tolist()))

    gravity = GroundFilter(Mounting(1.4), spread_deg=5.0)
    for _ in range(5):
        good = gravity.update(ground(pitch / 2, roll / 2))
    assert good.tilt_deviation_deg <= GROUND_TILT_DEG and np.dot(good.up, ground(pitch / 2, roll / 2).up) > 0.9999
    bad = gravity.update(ground(pitch / 2 + off, roll / 2))
    assert np.degrees(np.arccos(np.dot(bad.up, good.up))) < 3 and bad.tilt_deviation_deg > 2
    again = gravity.update(ground(pitch / 2, roll / 2))
    np.testing.assert_allclose(again.up, good.up, atol=0.003)


def test_a_stream_estimates_the_mounting_of_each_scan(hand):
    recording, turned, _ = hand
    gravity = sglpr_jax.GroundFilter(sglpr_jax.estimate_mounting(recording.points(0)))
    mountings = [gravity.add(recording.points(i)) for i in range(5)]
    assert angles_deg(mountings, turned[:5]).max() < 1
