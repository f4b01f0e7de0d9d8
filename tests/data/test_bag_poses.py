"""Poses among the topics of a bag: which are taken, at what times, in which frame, and when none are."""

import numpy as np
import pytest
from bags import FILES, header, typestore, write_bag

from sglpr_jax.data import open_recording
from sglpr_jax.data.formats.timed_poses import interpolate
from sglpr_jax.data.warning import DataWarning

CLOUD, ODOMETRY, POSE = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
LATE_S = 1000.0
"""The recorder's clock runs so much ahead of the sensors'."""


def cloud(kind, seconds):
    store = typestore(kind).types
    fields = [
        store["sensor_msgs/msg/PointField"](name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate("xyz")
    ]
    return store[CLOUD](
        header=header(kind, seconds, "lidar"),
        height=1,
        width=4,
        fields=fields,
        is_bigendian=False,
        point_step=12,
        row_step=48,
        data=np.random.default_rng(0).normal(size=12).astype("<f4").view(np.uint8),
        is_dense=True,
    )


def pose(kind, seconds, position, name=ODOMETRY):
    store = typestore(kind).types
    at = store["geometry_msgs/msg/Point"](x=position[0], y=position[1], z=position[2])
    plain = store["geometry_msgs/msg/Pose"](
        position=at, orientation=store["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    )
    if name == POSE:
        return store[POSE](header=header(kind, seconds, "map"), pose=plain)
    zero = store["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    twist = store["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
    return store[ODOMETRY](
        header=header(kind, seconds, "odom"),
        child_frame_id="base_link",
        pose=store["geometry_msgs/msg/PoseWithCovariance"](pose=plain, covariance=np.zeros(36)),
        twist=store["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )


def scans(kind, seconds):
    return [("/points", CLOUD, LATE_S + t, cloud(kind, t)) for t in seconds]


def poses(kind, topic, seconds, *, name=ODOMETRY, late=LATE_S, where=lambda t: (10 * t, -2 * t, 0.5)):
    return [(topic, name, late + t, pose(kind, t, where(t), name)) for t in seconds]


def opened(tmp_path, kind, messages):
    messages = sorted(messages, key=lambda message: message[2])
    return open_recording(write_bag(tmp_path / FILES[kind], kind, messages), sensor_height=1.7)


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize(("name", "frames"), [(ODOMETRY, "base_link in odom"), (POSE, "in map")])
def test_positions_are_interpolated_at_the_times_of_the_scans(tmp_path, kind, name, frames):
    times = np.arange(5.03, 6.9, 0.1)
    recording = opened(tmp_path, kind, scans(kind, times) + poses(kind, "/odom", np.arange(5.0, 7.1, 0.25), name=name))
    np.testing.assert_allclose(recording.times, times)
    np.testing.assert_allclose(recording.positions, np.stack([10 * times, -2 * times, 0 * times + 0.5], 1), atol=1e-5)
    assert recording.pose_source == f"/odom ({frames}, interpolated)"
    assert f"poses: /odom ({frames}, interpolated), over 18 x 4 m and 0 m of height" in recording.description[-1]


def test_scans_without_a_pose_are_left_out_and_counted(tmp_path):
    times = np.arange(5.0, 9.0, 0.5)
    recording = opened(tmp_path, "mcap", scans("mcap", times) + poses("mcap", "/odom", np.arange(6.45, 9.2, 0.5)))
    assert recording.ids == tuple(f"{i:06d}" for i in range(3, 8)) and len(recording.paths) == 5
    np.testing.assert_allclose(recording.times, times[3:])
    assert recording.pose_source == (
        "/odom (base_link in odom, interpolated; 3 of 8 scans left out, which have no pose)"
    )
    assert recording.points(4).shape == (4, 3)


def test_the_topic_with_most_scans_is_taken_and_a_goal_is_none(tmp_path):
    times = np.arange(5.0, 7.0, 0.1)
    goal = poses("ros1", "/goal", [5.5], name=POSE)
    half = poses("ros1", "/a_half", np.arange(5.0, 6.05, 0.1), where=lambda t: (0.0, 0.0, 0.0))
    all_of_them = poses("ros1", "/odom", times)
    recording = opened(tmp_path, "ros1", scans("ros1", times) + goal + half + all_of_them)
    assert recording.pose_source == "/odom (base_link in odom, interpolated)"
    assert "poses not used: /a_half (poses for 60% of the scans), /goal (poses for 0% of the scans)" in recording.found
    (tmp_path / FILES["ros1"]).unlink()
    recording = opened(tmp_path, "ros1", scans("ros1", times) + goal)
    assert recording.positions is None and recording.pose_source is None and len(recording) == 20
    assert "poses not used: /goal (poses for 0% of the scans)" in recording.found


def test_where_clocks_of_sensors_do_not_meet_the_recorders_is_taken(tmp_path):
    times = np.arange(5.0, 6.0, 0.1)
    strange = [
        (topic, name, t, pose("ros2", 77 + i, (t - LATE_S, 0.0, 0.0)))
        for i, (topic, name, t, _) in enumerate(poses("ros2", "/odom", times))
    ]
    recording = opened(tmp_path, "ros2", scans("ros2", times) + strange)
    np.testing.assert_allclose(recording.positions[:, 0], times, atol=1e-6)


def test_poses_that_are_not_finite_are_none(tmp_path):
    times = np.arange(5.0, 6.0, 0.1)
    where = {5.0: (np.nan, 0.0, 0.0)}
    track = poses("ros1", "/odom", times, where=lambda t: where.get(t, (1.0, 2.0, 3.0)))
    recording = opened(tmp_path, "ros1", scans("ros1", times) + track)
    np.testing.assert_array_equal(recording.positions, np.tile([1.0, 2.0, 3.0], (10, 1)))


def test_heights_that_run_as_far_as_a_road_are_warned_of(tmp_path):
    times = np.arange(5.0, 25.0, 1.0)
    track = poses("ros1", "/odom", np.arange(5.0, 26.0, 0.5), where=lambda t: (0.0, 0.1 * t, 10 * t))
    with pytest.warns(DataWarning, match=r"drive\.bag: expected z up, found heights over 190 m"):
        opened(tmp_path, "ros1", scans("ros1", times) + track)


def test_between_poses_far_apart_in_time_nothing_is_known():
    stamps, line = np.array([3.0, 0.0, 1.0, 3.5]), np.array([3.0, 0.0, 1.0, 3.5])[:, None] * [1.0, 2.0, 0.0]
    times = np.array([-0.2, -0.05, 0.5, 1.0, 2.0, 3.2, 3.55, 4.0])
    found = interpolate(stamps, line, times)
    assert found.kept.tolist() == [False, True, True, True, False, True, True, False]
    np.testing.assert_allclose(found.positions[[2, 3, 5], 1], [1.0, 2.0, 6.4])
    assert not interpolate(stamps[:1], line[:1], times).kept.any()
