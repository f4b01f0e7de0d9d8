"""Poses of scans from messages of odometry and tf."""

import threading
import time as clock

import numpy as np
import pytest

from sglpr_jax.live.ros_encoding import TRANSFORMS
from sglpr_jax.live.ros_odometry import MOUNTING_WAIT_S, LiveOdometry
from tests.live.messages import ODOMETRY, odometry, received, transforms

HALF = np.sqrt(0.5)


@pytest.fixture
def live(said) -> LiveOdometry:
    return LiveOdometry("/odom", said)


def drive(live: LiveOdometry, *seconds: float, child: str = "lidar", at: float | None = None) -> None:
    """A body that moves along x at 2 m/s."""
    for one in seconds:
        now = clock.monotonic() if at is None else at
        live.receive(received(ODOMETRY, odometry(one, (2 * one, 0, 0), child=child), at=now))


def test_a_scan_waits_for_the_pose_after_it(live, said):
    drive(live, 10.0, 10.1)
    later = threading.Timer(0.05, lambda: drive(live, 10.2))
    later.start()
    np.testing.assert_allclose(live.pose(10.2, "lidar", wait_s=5.0)[:3, 3], [20.4, 0, 0])
    later.join()
    assert not said


def test_a_scan_does_not_wait_for_odometry_that_stopped(live, said):
    drive(live, 10.0, 10.1, at=clock.monotonic() - 3)
    began = clock.monotonic()
    assert live.pose(10.9, "lidar", wait_s=5.0) is None
    assert clock.monotonic() - began < 1
    assert said.of("odometry") == ["/odom: expected a pose at 10.900, found none for 3 s"]


@pytest.mark.parametrize(
    "position, rotation",
    [
        ((1, 0, 0), (0, 0, 0, 0)),
        ((1, 0, 0), (0, 0, 0, 3)),
        ((np.nan, 0, 0), (0, 0, 0, 1)),
        ((1e300, 0, 0), (0, 0, 0, 1)),
    ],
)
def test_a_pose_that_cannot_be_is_left_out(live, said, position, rotation):
    drive(live, 10.0, 10.1)
    live.receive(received(ODOMETRY, odometry(10.15, position, rotation, child="lidar")))
    assert said.kinds == ["pose"] and "/odom: expected a position and a rotation, found" in said[0][1]
    drive(live, 10.2)
    np.testing.assert_allclose(live.pose(10.15, "lidar", wait_s=0.0)[:3, 3], [20.3, 0, 0])


@pytest.mark.parametrize(
    ("seconds", "position", "rotation"),
    [
        (10.15, (320.0, 0, 0), (0, 0, 0, 1)),
        (10.15, (20.3, 0, 0), (0, 0, 1, 0)),
        (0.0, (20.3, 0, 0), (0, 0, 0, 1)),
        (1e9, (20.3, 0, 0), (0, 0, 0, 1)),
    ],
)
def test_a_single_pose_that_cannot_follow_is_left_out(live, said, seconds, position, rotation):
    drive(live, 10.0, 10.1)
    live.receive(received(ODOMETRY, odometry(seconds, position, rotation, child="lidar")))
    drive(live, 10.2, 10.3)
    np.testing.assert_allclose(live.pose(10.15, "lidar", wait_s=0.0)[:3, 3], [20.3, 0, 0])
    np.testing.assert_allclose(live.pose(10.05, "lidar", wait_s=0.0)[:3, 3], [20.1, 0, 0])
    assert said.kinds == ["step"]


def test_a_pose_may_be_repeated(live):
    drive(live, 10.0, 10.1, 10.1)
    np.testing.assert_allclose(live.pose(10.1, "lidar", wait_s=0.0)[:3, 3], [20.2, 0, 0])


def test_odometry_that_begins_anew_is_taken_from_its_second_pose(live, said):
    drive(live, 10.0, 10.1)
    for seconds in (10.2, 10.3):
        live.receive(received(ODOMETRY, odometry(seconds, (500 + seconds, 0, 0), child="lidar")))
    np.testing.assert_allclose(live.pose(10.25, "lidar", wait_s=0.0)[:3, 3], [510.25, 0, 0])
    assert live.pose(9.1, "lidar", wait_s=0.0) is None
    assert said.kinds == ["step", "odometry"]


@pytest.mark.parametrize("child", ["", "lidar", "garbage"])
def test_frames_of_a_single_pose_are_not_chosen(live, child):
    damaged = [("garbage", child, (0, 0, 0), (0, 0, 0, 1))]
    live.receive(received(TRANSFORMS, transforms(10.0, damaged), at=clock.monotonic()))
    assert live.pose(10.0, "lidar", wait_s=0.0) is None
    drive(live, 10.0, 10.1, child="base")
    live._first_received -= MOUNTING_WAIT_S
    np.testing.assert_allclose(live.pose(10.1, "lidar", wait_s=0.0)[:3, 3], [20.2, 0, 0])


def test_a_scan_of_a_time_far_ahead_does_not_wait(live):
    drive(live, 10.0, 10.1)
    began = clock.monotonic()
    assert live.pose(100.0, "lidar", wait_s=5.0) is None
    assert clock.monotonic() - began < 1


def test_poses_of_another_clock_are_reported(live, said):
    drive(live, 10.0, 10.1)
    assert live.pose(1e9, "lidar", wait_s=0.01) is None
    assert "found poses from 10.000 to 10.100" in said.of("odometry")[0]


def test_the_mounting_comes_from_tf_static(live, said):
    drive(live, 10.0, 10.1, child="/base")
    static = [("base", "mast", (0, 0, 1), (0, 0, 0, 1)), ("mast", "lidar", (1, 0, 0), (0, 0, HALF, HALF))]
    live.receive_static(received(TRANSFORMS, transforms(0, static)))
    found = live.pose(10.1, "lidar", wait_s=0.0)
    np.testing.assert_allclose(found[:3, 3], [21.2, 0, 1], atol=1e-9)
    np.testing.assert_allclose(found[:2, :2], [[0, -1], [1, 0]], atol=1e-9)
    assert not said


def test_a_mounting_that_tf_does_not_state_is_waited_for_and_then_left_out(live, said):
    drive(live, 10.0, 10.1, child="base")
    assert live.pose(10.1, "lidar", wait_s=0.0) is None
    live._first_received -= MOUNTING_WAIT_S
    np.testing.assert_allclose(live.pose(10.1, "lidar", wait_s=0.0)[:3, 3], [20.2, 0, 0])
    assert "/tf_static: expected base and lidar, found no path" in said.of("mounting")[0]
    live.receive_static(received(TRANSFORMS, transforms(0, [("base", "lidar", (9, 0, 0), (0, 0, 0, 1))])))
    np.testing.assert_allclose(live.pose(10.1, "lidar", wait_s=0.0)[:3, 3], [20.2, 0, 0])  # no jump while it drives


def test_of_tf_that_transform_is_used_that_moves_the_lidar(live, said):
    still = (0, 0, 0, 1)
    live.receive_static(received(TRANSFORMS, transforms(0, [("base", "lidar", (0, 0, 2), still)])))
    for seconds in (5.0, 5.1):
        found = [("map", "odom", (100, 0, 0), still), ("odom", "base", (seconds, 0, 0), still)]
        live.receive(received(TRANSFORMS, transforms(seconds, found), at=clock.monotonic()))
    np.testing.assert_allclose(live.pose(5.05, "lidar", wait_s=0.0)[:3, 3], [5.05, 0, 2])


def test_times_that_jump_back_begin_another_odometry(live):
    drive(live, 10.0, 10.1, 3.0, 3.1)
    np.testing.assert_allclose(live.pose(3.05, "lidar", wait_s=0.0)[:3, 3], [6.1, 0, 0])
    assert live.pose(10.05, "lidar", wait_s=0.0) is None
