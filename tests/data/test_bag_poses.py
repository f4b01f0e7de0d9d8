"""Poses among the topics of a bag: which are taken, at what times, in which frame, and when none are."""

import numpy as np
import pytest
from bags import FILES, TRANSFORMS, header, transforms, typestore, write_bag
from scipy.spatial.transform import Rotation

from sglpr_jax.data.poses import have_poses, interpolate_poses, poses_of
from sglpr_jax.data.readers import open_recording, recording_names

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


def turned(seconds):
    """A quaternion that goes about an axis that is no axis of the frame, by .2 radians a second."""
    return Rotation.from_rotvec(0.2 * seconds * np.array([0.1, 0.2, 0.9])).as_quat()


def never(seconds):
    return (0.0, 0.0, 0.0, 1.0)


def pose(kind, seconds, position, name=ODOMETRY, quaternion=(0.0, 0.0, 0.0, 1.0)):
    store = typestore(kind).types
    at = store["geometry_msgs/msg/Point"](x=position[0], y=position[1], z=position[2])
    plain = store["geometry_msgs/msg/Pose"](
        position=at, orientation=store["geometry_msgs/msg/Quaternion"](*map(float, quaternion))
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


def poses(kind, topic, seconds, *, name=ODOMETRY, late=LATE_S, where=lambda t: (10 * t, -2 * t, 0.5), turns=turned):
    return [(topic, name, late + t, pose(kind, t, where(t), name, turns(t))) for t in seconds]


def tf(kind, topic, seconds, *found):
    return [(topic, TRANSFORMS, LATE_S + t, transforms(kind, t, [one(t) for one in found])) for t in seconds]


def expected_poses(times, base_from_lidar):
    world_from_base = np.tile(np.eye(4), (len(times), 1, 1))
    world_from_base[:, :3, :3] = Rotation.from_quat([turned(t) for t in times]).as_matrix()
    world_from_base[:, :3, 3] = np.stack([10 * times, -2 * times, 0 * times + 0.5], 1)
    return world_from_base @ base_from_lidar


def opened(tmp_path, kind, messages, **options):
    messages = sorted(messages, key=lambda message: message[2])
    return open_recording(write_bag(tmp_path / FILES[kind], kind, messages), sensor_height=1.7, **options)


@pytest.mark.parametrize(
    ("kind", "name", "frames"),
    [
        ("ros1", ODOMETRY, "base_link in odom"),
        ("ros2", ODOMETRY, "base_link in odom"),
        ("ros1", POSE, "a body in map"),
        ("mcap", POSE, "a body in map"),
    ],
)
def test_positions_are_interpolated_at_the_times_of_the_scans(tmp_path, kind, name, frames):
    times = np.arange(5.03, 6.9, 0.1)
    recording = opened(tmp_path, kind, scans(kind, times) + poses(kind, "/odom", np.arange(5.0, 7.1, 0.25), name=name))
    np.testing.assert_allclose(recording.times, times)
    np.testing.assert_allclose(recording.positions, np.stack([10 * times, -2 * times, 0 * times + 0.5], 1), atol=1e-5)
    np.testing.assert_allclose(recording.world_from_lidar, expected_poses(times, np.eye(4)), atol=1e-5)
    untransformed = "interpolated; used as poses of lidar, since tf does not connect the two frames"
    how = "interpolated" if name == POSE else untransformed
    assert recording.pose_source == f"/odom (9 poses of {frames}, {how})"
    assert f"poses: /odom (9 poses of {frames}, {how}), over 18 x 4 m and 0 m of height" in recording.description[-1]


def test_scans_without_a_pose_are_left_out_and_counted(tmp_path):
    times = np.arange(5.0, 9.0, 0.5)
    recording = opened(tmp_path, "mcap", scans("mcap", times) + poses("mcap", "/odom", np.arange(6.45, 9.2, 0.5)))
    assert recording.ids == tuple(f"{i:06d}" for i in range(3, 8)) and recording.numbers.tolist() == [3, 4, 5, 6, 7]
    np.testing.assert_allclose(recording.times, times[3:])
    assert recording.pose_source == (
        "/odom (6 poses of base_link in odom, interpolated; used as poses of lidar, since tf does not connect the two "
        "frames; 3 of 8 scans left out, which have no pose)"
    )
    assert recording.points(4).shape == (4, 3)
    np.testing.assert_allclose(recording.world_from_lidar, expected_poses(times[3:], np.eye(4)), atol=1e-5)


def test_the_topic_with_most_scans_is_taken_and_a_goal_is_none(tmp_path):
    times = np.arange(5.0, 7.0, 0.1)
    goal = poses("ros1", "/goal", [5.5], name=POSE)
    half = poses("ros1", "/a_half", np.arange(5.0, 6.05, 0.1), where=lambda t: (0.0, 0.0, 0.0))
    all_of_them = poses("ros1", "/odom", times)
    recording = opened(tmp_path, "ros1", scans("ros1", times) + goal + half + all_of_them)
    assert recording.pose_source.startswith("/odom (20 poses of base_link in odom, interpolated")
    assert "poses not used: /a_half (poses for 60% of the scans), /goal (poses for 0% of the scans)" in recording.found
    (tmp_path / "named").mkdir()
    chosen = opened(tmp_path / "named", "ros1", scans("ros1", times) + half + all_of_them, pose_topic="/a_half")
    assert len(chosen) == 12 and not chosen.positions.any() and chosen.pose_source.startswith("/a_half (11 poses of ")
    for topic, words in (("/goal", "poses for at least half of the scans on /goal, found 0%"), ("/no", "/goal, /odom")):
        with pytest.raises(ValueError, match=rf"drive\.bag: expected .*{words}"):
            open_recording(tmp_path / FILES["ros1"], pose_topic=topic)
    (tmp_path / FILES["ros1"]).unlink()
    recording = opened(tmp_path, "ros1", scans("ros1", times) + goal)
    assert recording.positions is None and recording.pose_source is None and len(recording) == 20
    assert "poses not used: /goal (poses for 0% of the scans)" in recording.found


QUARTER = Rotation.from_euler("xyz", [3.0, 1.0, 90.0], degrees=True).as_quat()
BASE_FROM_LIDAR = np.eye(4)
BASE_FROM_LIDAR[:3, :3], BASE_FROM_LIDAR[:3, 3] = Rotation.from_quat(QUARTER).as_matrix(), (1.0, 0.2, 1.5)


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_poses_of_the_vehicle_become_those_of_the_lidar_where_tf_says_how_it_is_mounted(tmp_path, kind):
    times = np.arange(5.03, 6.9, 0.1)
    mast = ("base_link", "mast", (1.0, 0.2, 1.5), (0, 0, 0, 1))
    down = Rotation.from_quat(QUARTER).inv().as_quat()
    fixed = tf(kind, "/tf_static", [5.0], lambda t: mast, lambda t: ("lidar", "/mast", (0, 0, 0), down))
    wheel = tf(kind, "/tf", np.arange(5.0, 7.1, 0.25), lambda t: ("base_link", "wheel", (0, 0, 0), turned(9 * t)))
    track = poses(kind, "/odom", np.arange(5.0, 7.1, 0.25))
    recording = opened(tmp_path, kind, scans(kind, times) + fixed + wheel + track)
    np.testing.assert_allclose(recording.world_from_lidar, expected_poses(times, BASE_FROM_LIDAR), atol=1e-5)
    np.testing.assert_array_equal(recording.positions, recording.world_from_lidar[:, :3, 3])
    assert recording.pose_source == "/odom (9 poses of base_link in odom, interpolated, moved to lidar by tf)"


def test_without_a_topic_of_poses_tf_is_one(tmp_path):
    """Even where its fixed transforms are said again and again, as ROS 1 did."""
    times, often = np.arange(5.0, 9.0, 0.1), np.arange(4.9, 9.2, 0.05)
    found = (
        lambda t: ("odom", "base_link", (10 * t, -2 * t, 0.5), turned(t)),
        lambda t: ("base_link", "lidar", (1.0, 0.2, 1.5), QUARTER),
        lambda t: ("base_link", "arm", (t, 0.0, 0.0), (0, 0, 0, 1)),
    )
    recording = opened(tmp_path, "ros1", scans("ros1", times) + tf("ros1", "/tf", often, *found))
    np.testing.assert_allclose(recording.world_from_lidar, expected_poses(times, BASE_FROM_LIDAR), atol=1e-5)
    said = "/tf/odom/base_link (86 poses of base_link in odom, interpolated, moved to lidar by tf)"
    assert recording.pose_source == said


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)])
def test_rotations_that_nobody_measured_are_none(tmp_path, quaternion):
    times = np.arange(5.0, 6.0, 0.1)
    track = poses("ros2", "/gps", times, turns=lambda t: quaternion)
    recording = opened(tmp_path, "ros2", scans("ros2", times) + track)
    assert recording.world_from_lidar is None and len(recording.positions) == len(times)
    assert recording.pose_source.endswith("interpolated; its rotations are constant or missing)")


def test_bags_of_two_days_are_two_recordings(tmp_path):
    times, folder = np.arange(5.0, 7.0, 0.1), tmp_path / "bags"
    folder.mkdir()
    for day, (name, where) in enumerate({"monday": 0.0, "tuesday": 234.0}.items()):
        for part, some in enumerate((times[:10], times[10:])):
            clock = 86400.0 * day + some
            track = poses("ros1", "/odom", clock, where=lambda t, x=where: (x, t % 86400, 0.0))
            messages = sorted(scans("ros1", clock) + track, key=lambda message: message[2])
            write_bag(folder / f"{name}_{part}.bag", "ros1", messages)
    assert recording_names(folder) == ("monday_0", "tuesday_0")
    with pytest.raises(FileNotFoundError, match="expected the name of one sequence, found monday_0, tuesday_0"):
        open_recording(folder)
    for name, x in (("monday_0", 0.0), ("tuesday_0", 234.0)):
        recording = open_recording(folder, name, sensor_height=1.7)
        assert len(recording) == 20
        np.testing.assert_allclose(recording.positions[:, 0], x)


def test_rotations_between_two_are_those_of_an_even_turn():
    stamps = np.array([2.0, 0.0, 1.0, 2.0])
    quaternions = np.stack([turned(t) for t in stamps]) * np.array([[1], [1], [-1], [1]])  # -q turns as q does
    times = np.array([-1.0, 0.0, 0.25, 1.0, 1.9, 2.5])
    found = interpolate_poses(stamps, poses_of(np.zeros((4, 3)), Rotation.from_quat(quaternions).as_matrix()), times)[
        :, :3, :3
    ]
    true = Rotation.from_quat([turned(t) for t in times.clip(0, 2)])
    np.testing.assert_allclose(found, true.as_matrix(), atol=1e-9)


def test_between_poses_far_apart_in_time_nothing_is_known():
    stamps, line = np.array([3.0, 0.0, 1.0, 3.5]), np.array([3.0, 0.0, 1.0, 3.5])[:, None] * [1.0, 2.0, 0.0]
    times = np.array([-0.2, -0.05, 0.5, 1.0, 2.0, 3.2, 3.55, 4.0])
    assert have_poses(stamps, times).tolist() == [False, True, True, True, False, True, True, False]
    found = interpolate_poses(stamps, poses_of(line), times)
    np.testing.assert_allclose(found[[2, 3, 5], 1, 3], [1.0, 2.0, 6.4])
    assert not have_poses(stamps[:1], times).any()
