"""Deskewing undoes the motion of a sensor within a scan."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import of_scans
from scipy.linalg import expm, logm

import sglpr_jax
from sglpr_jax.data.deskew import deskew, deskewed, point_times_problem, poses_at
from sglpr_jax.data.scan import Scan, TimeField
from sglpr_jax.files import DataWarning

RATE_S = 0.1
WORLD = np.random.default_rng(0).uniform([-40, -40, -2], [40, 40, 6], (24, 3))
WITHIN = np.linspace(-0.1, 0.1, 24).astype(np.float32)


def twist(turn, shift) -> np.ndarray:
    """Velocity in the moving frame as a matrix, whose exponential is a motion."""
    (x, y, z), found = turn, np.zeros((4, 4))
    found[:3, :3], found[:3, 3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]], shift
    return found


def measured(world_from_lidar: np.ndarray, point: np.ndarray) -> np.ndarray:
    """A point of the world as the sensor at a pose sees it."""
    return (point - world_from_lidar[:3, 3]) @ world_from_lidar[:3, :3]


def drive(velocity: np.ndarray, *, scans: int = 4, begin: float = 20.0):
    """Times, poses and skewed scans of a sensor with a constant velocity in its own frame."""
    times = begin + RATE_S * np.arange(scans)
    poses = np.array([expm(velocity * (time - begin)) for time in times])
    skewed = [
        np.array(list(map(measured, expm(velocity * (time + WITHIN - begin)[:, None, None]), WORLD))) for time in times
    ]
    return times, poses, [cloud.astype(np.float32) for cloud in skewed]


def recording_of(times, clouds, *, field: str = "time", within=WITHIN, **fields):
    """A recording whose points have times."""
    plain = of_scans({Path(f"{i:03d}.bin"): cloud for i, cloud in enumerate(clouds)}, times=times, **fields)

    def read(path, labels):
        return dataclasses.replace(plain.read(path, labels), time_field=TimeField(field, within))

    return dataclasses.replace(plain, read=read)


@settings(max_examples=5, deadline=None)
@given(*[st.floats(-3, 3)] * 3, *[st.floats(-15, 15)] * 3)
def test_a_constant_velocity_is_removed(roll, pitch, yaw, x, y, z):
    times, poses, clouds = drive(twist([roll, pitch, yaw], [x, y, z]), scans=2)
    for time, pose, cloud in zip(times, poses, clouds, strict=True):
        found = deskew(cloud, WITHIN, time=time, pose_times=times, world_from_lidar=poses)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, measured(pose, WORLD), atol=2e-3)


@settings(max_examples=10, deadline=None)
@given(st.lists(st.floats(-2, 2), min_size=6, max_size=6), st.floats(-0.5, 1.5))
def test_interpolation_equals_the_matrix_logarithm(numbers, share):
    start = expm(twist(numbers[3:], numbers[:3]))
    end = start @ expm(twist(numbers[:3], numbers[3:]) / 2)
    expected = start @ expm(share * np.real(logm(np.linalg.inv(start) @ end)))
    found = poses_at(np.array([5 + 2 * share]), np.array([5.0, 7.0]), np.array([start, end]))
    np.testing.assert_allclose(found[0], expected, atol=1e-6)


def test_interpolation_uses_the_poses_before_and_after_each_time():
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = [0, 1, 5, 6]
    found = poses_at(np.array([-0.5, 0.5, 1.0, 1.5, 2.0, 2.5, 3.5]), np.arange(4.0), poses)
    np.testing.assert_allclose(found[:, 0, 3], [-0.5, 0.5, 1, 3, 5, 5.5, 6.5])


def test_a_recording_is_deskewed_and_a_scan_without_a_neighbour_stays():
    times, poses, clouds = drive(twist([0, 0, 3], [2, 0, 0]))
    times[3] = 60.0
    clouds[1][7] = np.nan
    found = deskewed(recording_of(times, clouds), poses)
    for row in range(3):
        expected = measured(poses[row], WORLD)
        expected[7 if row == 1 else []] = np.nan
        np.testing.assert_allclose(found.points(row), expected, atol=2e-3)
    np.testing.assert_array_equal(found.points(3), clouds[3])
    assert found.found[-1].endswith("but 1 of 4 scans have no neighbour within 1 s")
    assert found.read_options["deskewed"] != deskewed(recording_of(times, clouds), 1.0 * poses[::-1]).read_options
    with pytest.raises(ValueError, match="expected times of the points to remove the motion within scans, found none"):
        deskewed(found, poses)


def test_only_scans_without_valid_times_of_points_are_not_deskewed():
    times, poses, clouds = drive(twist([0, 0, 3], [2, 0, 0]))
    recording = recording_of(times, clouds)

    def read(path, labels):
        scan = recording.read(path, labels)
        others = {"000": TimeField("time", 0 * WITHIN), "001": None}
        return dataclasses.replace(scan, time_field=others.get(path.stem, scan.time_field))

    odd = dataclasses.replace(recording, read=read)
    assert not point_times_problem(odd)
    found = deskewed(odd, poses)
    with pytest.warns(DataWarning, match="scan 000 of sequence 08: expected times .* motion within this scan is not"):
        np.testing.assert_array_equal(found.points(0), clouds[0])
    np.testing.assert_array_equal(found.points(1), clouds[1])
    np.testing.assert_allclose(found.points(2), measured(poses[2], WORLD), atol=2e-3)


def test_why_scans_cannot_be_deskewed_is_said():
    times, _, clouds = drive(twist([0, 0, 1], [5, 0, 0]))
    recording = recording_of(times, clouds)
    times = times[[0, 1, 1, 3]]
    assert point_times_problem(recording) == ""
    for problem, other in (
        ("scan 002 is not later than the scan before it", dataclasses.replace(recording, times=times)),
        ("no times of scans", dataclasses.replace(recording, times=None)),
        ("no valid times of points", recording_of(times, clouds, within=0 * WITHIN)),
    ):
        assert point_times_problem(other) == problem


def test_invalid_arguments_are_one_clear_error():
    times, poses, clouds = drive(twist([0, 0, 1], [5, 0, 0]), scans=2)
    for changed, message in (
        ({"times": None}, "sequence 08: expected times of the scans to remove their motion, found none"),
        ({"read": lambda *_: Scan(points=np.ones((5, 3), np.float32))}, "expected times of the points to remove"),
    ):
        with pytest.raises(ValueError, match=message):
            deskewed(dataclasses.replace(recording_of(times, clouds), **changed), poses)
    zeros = recording_of(times, clouds, within=np.zeros(24, np.float32))
    with pytest.raises(ValueError, match=r"scan 000 of sequence 08: expected times of points over .* found 0 to 0"):
        deskewed(zeros, poses)
    with pytest.raises(ValueError, match=r"08: expected poses \(n, 4, 4\), with rotations, found .* in row 0"):
        deskewed(recording_of(times, clouds), 0 * poses)
    options = {"time": times[0], "pose_times": times, "world_from_lidar": poses}
    for wrong in ({"pose_times": times[::-1]}, {"pose_times": times[:1], "world_from_lidar": poses[:1]}):
        with pytest.raises(ValueError, match="deskew: expected two poses or more at increasing times, found"):
            sglpr_jax.deskew(clouds[0], WITHIN, **{**options, **wrong})
    for within in (1e9 + WITHIN, 1e9 * WITHIN, np.nan * WITHIN):
        with pytest.raises(ValueError, match="deskew: expected for each point its time relative to the scan"):
            sglpr_jax.deskew(clouds[0], within, **options)
