"""Bags of both ROSes and mcap, written here: clouds, times, poses and their frames, and broken files."""

import struct
import sys
from collections.abc import Callable

import numpy as np
import pytest
from bags import CLOUD, FILES, ODOMETRY, POSE, TRANSFORMS, cloud, pose, transforms, write_bag
from clouds import points_of
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode
from scipy.spatial.transform import Rotation

from sglpr_jax.data.formats.ros_messages import Stamps, times_on_one_clock
from sglpr_jax.data.poses import have_poses, interpolate_poses
from sglpr_jax.data.readers import open_recording, recording_names, ros
from sglpr_jax.data.scan_stream import only_readable
from sglpr_jax.files import DataWarning
from sglpr_jax.se3 import poses_of

LATE_S = 1000.0
"""The recorder's clock runs so much ahead of the sensors'."""
RINGS = (np.arange(24) % 16).astype("<u2")


def scans(kind, seconds=(100.0, 100.1, 100.2), topic="/points"):
    return [(topic, CLOUD, LATE_S + i / 10, cloud(kind, t, points_of(i), ring=RINGS)) for i, t in enumerate(seconds)]


def drive(path, kind, messages=None, **options):
    return write_bag(path / FILES[kind], kind, scans(kind) if messages is None else messages, **options)


@pytest.mark.parametrize("kind", FILES)
def test_a_bag_is_a_recording(tmp_path, kind):
    root = drive(tmp_path, kind)
    assert recording_names(root) == ("drive",)
    recording = open_recording(root)
    assert recording.ids == ("000000", "000001", "000002") and recording.positions is None
    np.testing.assert_allclose(recording.times, [100, 100.1, 100.2])
    assert f"/points of {root.name}, x y z ring (14 bytes a point)" in recording.found[0]
    for i in (2, 0, 1):
        scan = recording.scan(i)
        np.testing.assert_array_equal(scan.points, points_of(i))
        np.testing.assert_array_equal(scan.lasers, RINGS)


@pytest.mark.parametrize(
    ("kind", "compression"),
    [
        ("ros1", (Writer1.CompressionFormat.BZ2,)),
        ("ros1", (Writer1.CompressionFormat.LZ4,)),
        ("ros2", (CompressionMode.FILE, CompressionFormat.ZSTD)),
        ("ros2", (CompressionMode.MESSAGE, CompressionFormat.ZSTD)),
        ("mcap", (CompressionMode.STORAGE, CompressionFormat.ZSTD)),
    ],
    ids=str,
)
def test_compressed_bags(tmp_path, kind, compression):
    root = drive(tmp_path, kind, compression=compression)
    for i in range(3):
        np.testing.assert_array_equal(open_recording(root).points(i), points_of(i))
    for path in root.glob("drive.*.zstd"):
        with pytest.raises(ValueError, match=r"drive\.\w+\.zstd: .* open the folder with .*drive/metadata\.yaml$"):
            open_recording(path)
    if kind == "ros2":
        (root / "metadata.yaml").unlink()
        with pytest.raises(ValueError, match=r"drive\.(mcap|db3).*: expected .*metadata\.yaml is missing"):
            open_recording(root)


@pytest.mark.parametrize(("log", "lone"), [("wal", True), ("journal", False)])
def test_a_log_beside_a_bag_of_sqlite_is_named(tmp_path, log, lone):
    path = drive(tmp_path, "ros2")
    (path / f"drive.db3-{log}").write_bytes(b"")
    assert len(open_recording(path)) == 3, "an empty log is left by a recorder that ended well"
    (path / f"drive.db3-{log}").write_bytes(b"messages")
    with pytest.raises(ValueError, match=rf"drive\.db3: expected a bag that its recorder has closed, found .*-{log} "):
        open_recording(path / "drive.db3" if lone else path)


@pytest.mark.parametrize("kind", ["ros2", "mcap"])
def test_a_recording_of_a_killed_recorder_has_no_metadata(tmp_path, kind):
    root = drive(tmp_path, kind)
    (root / "metadata.yaml").unlink()
    np.testing.assert_array_equal(open_recording(root).points(2), points_of(2))
    (file,) = root.iterdir()
    assert open_recording(file).name == "drive"
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"drive\.\w+: expected an intact ROS bag, .*metadata\.yaml is missing"):
        open_recording(root)
    (root / "metadata.yaml").touch()
    with pytest.raises(ValueError, match=r"drive: expected an intact ROS bag, .*; metadata\.yaml or a file that it"):
        open_recording(root)


def test_an_empty_cloud_among_others_is_named_and_can_be_skipped(tmp_path):
    messages = scans("mcap")
    empty = messages[1][3]
    empty.width, empty.row_step, empty.data = 0, 0, np.zeros(0, np.uint8)
    recording = open_recording(drive(tmp_path, "mcap", messages))
    with pytest.raises(ValueError, match=r"scan 000001: .*drive.*: expected a cloud with points on /points"):
        recording.points(1)
    told = []
    assert only_readable(recording, on_bad_scan=lambda scan, error: told.append(scan)).ids == ("000000", "000002")
    assert told == ["000001"]


def test_fewer_messages_than_the_statistics_declare(tmp_path):
    root = drive(tmp_path, "mcap")
    (root / "metadata.yaml").unlink()
    (file,) = root.iterdir()
    content = file.read_bytes()
    at = content.rindex(struct.pack("<IHQ", 10, 1, 3))  # messages of each channel: three of the first
    file.write_bytes(content[:at] + struct.pack("<IHQ", 10, 1, 4) + content[at + 14 :])
    with pytest.raises(ValueError, match=r"drive\.mcap: .*expected 4 messages on /points by its statistics, f"):
        open_recording(root)


def test_folders_of_bags_topics_and_times_that_go_back(tmp_path):
    (tmp_path / "parts").mkdir()
    for i in range(2):
        messages = scans("ros1", (3 * i + 1, 3 * i + 2, 3 * i + 3))
        write_bag(tmp_path / f"parts/part{i}.bag", "ros1", messages)
    recording = open_recording(tmp_path / "parts")
    assert recording.name == "parts" and len(recording) == 6
    (tmp_path / "two").mkdir()
    root = drive(tmp_path / "two", "ros1", scans("ros1", topic="/ouster/points") + scans("ros1", (5, 4, 6), "/livox"))
    assert recording_names(root) == ("livox", "ouster_points")
    np.testing.assert_allclose(open_recording(root, "livox").times, LATE_S + np.arange(3) / 10)


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_bags_without_clouds_and_broken_bags_are_named(tmp_path, kind):
    root = drive(tmp_path, kind, [("/odom", ODOMETRY, 1.0, pose(kind, 1.0, (0, 0, 0)))])
    with pytest.raises(ValueError, match=r"drive.*: expected a topic of point clouds .* found /odom \(nav_msgs"):
        open_recording(root)
    name, content = {"ros1": ("a.bag", b"#ROSBAG V2.0\n" + bytes(90)), "mcap": ("a.mcap", b"")}[kind]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{name}: expected an intact ROS bag, found a broken one"):
        recording_names(tmp_path / name)


def test_without_the_extra_it_is_named(tmp_path, monkeypatch):
    root = drive(tmp_path, "ros1")
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(ImportError, match=r"drive\.bag: bags need the extra `ros`"):
        ros.recording_names(root)


def turned(seconds: float) -> np.ndarray:
    """A quaternion that goes about an axis that is no axis of the frame, by .2 radians a second."""
    return Rotation.from_rotvec(0.2 * seconds * np.array([0.1, 0.2, 0.9])).as_quat()


def where(seconds: float) -> tuple[float, float, float]:
    return (10 * seconds, -2 * seconds, 0.5)


Move = Callable[[float], object]


def clouds(kind, seconds):
    return [("/points", CLOUD, LATE_S + t, cloud(kind, t, points_of(0)[:4])) for t in seconds]


def poses(kind, topic, seconds, *, name=ODOMETRY, at: Move = where, turns: Move = turned):
    return [(topic, name, LATE_S + t, pose(kind, t, at(t), turns(t), name)) for t in seconds]


def tf(kind, topic, seconds, *found: Move):
    return [(topic, TRANSFORMS, LATE_S + t, transforms(kind, t, [one(t) for one in found])) for t in seconds]


def expected_poses(times, base_from_lidar):
    turns = Rotation.from_quat([turned(t) for t in times]).as_matrix()
    return poses_of(np.array([where(t) for t in times]), turns) @ base_from_lidar


def opened(tmp_path, kind, messages, **options):
    messages = sorted(messages, key=lambda message: message[2])
    return open_recording(drive(tmp_path, kind, messages), sensor_height=1.7, **options)


def test_a_scan_that_comes_late_is_read_at_its_time(tmp_path):
    times = np.arange(5.0, 25.0, 0.1)
    came = LATE_S + times + 0.15 * (np.arange(200) == 50)
    messages = [("/points", CLOUD, came[i], cloud("mcap", times[i], points_of(i)[:4])) for i in range(200)]
    track = [("/odom", ODOMETRY, LATE_S + t + 0.5, pose("mcap", t, where(t), turned(t))) for t in times]
    recording = opened(tmp_path, "mcap", messages + track)
    np.testing.assert_allclose(recording.times, times)
    np.testing.assert_allclose(recording.positions, [where(t) for t in times], atol=1e-4)
    np.testing.assert_array_equal(recording.points(50), points_of(50)[:4])


UNCONNECTED = "interpolated; used as poses of lidar, since tf does not connect the two frames"


@pytest.mark.parametrize(
    ("kind", "name", "said"),
    [
        ("ros1", ODOMETRY, f"base_link in odom, {UNCONNECTED}"),
        ("ros2", ODOMETRY, f"base_link in odom, {UNCONNECTED}"),
        ("ros1", POSE, "a body in map, interpolated"),
        ("mcap", POSE, "a body in map, interpolated"),
    ],
)
def test_poses_are_interpolated_at_the_times_of_the_scans(tmp_path, kind, name, said):
    times = np.arange(5.03, 6.9, 0.1)
    recording = opened(tmp_path, kind, clouds(kind, times) + poses(kind, "/odom", np.arange(5.0, 7.1, 0.25), name=name))
    np.testing.assert_allclose(recording.times, times)
    np.testing.assert_allclose(recording.world_from_lidar, expected_poses(times, np.eye(4)), atol=1e-5)
    np.testing.assert_array_equal(recording.positions, recording.world_from_lidar[:, :3, 3])
    assert recording.pose_source == f"/odom (9 poses of {said})"
    assert f"poses: /odom (9 poses of {said}), over 18 x 4 m and 0 m of height" in recording.description[-1]


def test_scans_without_a_pose_are_left_out_and_counted(tmp_path):
    times = np.arange(5.0, 9.0, 0.5)
    recording = opened(tmp_path, "mcap", clouds("mcap", times) + poses("mcap", "/odom", np.arange(6.45, 9.2, 0.5)))
    assert recording.ids == tuple(f"{i:06d}" for i in range(3, 8)) and recording.numbers.tolist() == [3, 4, 5, 6, 7]
    np.testing.assert_allclose(recording.times, times[3:])
    assert recording.pose_source.endswith(f"{UNCONNECTED}; 3 of 8 scans left out, which have no pose)")
    assert recording.points(4).shape == (4, 3)
    np.testing.assert_allclose(recording.world_from_lidar, expected_poses(times[3:], np.eye(4)), atol=1e-5)


def test_the_topic_with_most_scans_is_taken_and_a_goal_is_none(tmp_path):
    times = np.arange(5.0, 7.0, 0.1)
    goal = poses("ros1", "/goal", [5.5], name=POSE)
    half = poses("ros1", "/a_half", np.arange(5.0, 6.05, 0.1), at=lambda t: (0.0, 0.0, 0.0))
    whole = poses("ros1", "/odom", times)
    recording = opened(tmp_path, "ros1", clouds("ros1", times) + goal + half + whole)
    assert recording.pose_source.startswith("/odom (20 poses of base_link in odom, interpolated")
    assert "poses not used: /a_half (poses for 60% of the scans), /goal (poses for 0% of the scans)" in recording.found
    root = tmp_path / FILES["ros1"]
    chosen = open_recording(root, sensor_height=1.7, pose_topic="/a_half")
    assert len(chosen) == 12 and not chosen.positions.any() and chosen.pose_source.startswith("/a_half (11 poses of ")
    for topic, words in (("/goal", "poses for at least half of the scans on /goal, found 0%"), ("/no", "/goal, /odom")):
        with pytest.raises(ValueError, match=rf"drive\.bag: expected .*{words}"):
            open_recording(root, pose_topic=topic)
    root.unlink()
    recording = opened(tmp_path, "ros1", clouds("ros1", times) + goal)
    assert recording.positions is None and "poses not used: /goal (poses for 0% of the scans)" in recording.found


QUARTER = Rotation.from_euler("xyz", [3.0, 1.0, 90.0], degrees=True).as_quat()
BASE_FROM_LIDAR = poses_of(np.array([[1.0, 0.2, 1.5]]), Rotation.from_quat([QUARTER]).as_matrix())[0]


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_poses_of_the_vehicle_become_those_of_the_lidar_where_tf_says_how_it_is_mounted(tmp_path, kind):
    times, often = np.arange(5.03, 6.9, 0.1), np.arange(5.0, 7.1, 0.25)
    mast = ("base_link", "mast", (1.0, 0.2, 1.5), (0, 0, 0, 1))
    down = Rotation.from_quat(QUARTER).inv().as_quat()
    fixed = tf(kind, "/tf_static", [5.0], lambda t: mast, lambda t: ("lidar", "/mast", (0, 0, 0), down))
    wheel = tf(kind, "/tf", often, lambda t: ("base_link", "wheel", (0, 0, 0), turned(9 * t)))
    recording = opened(tmp_path, kind, clouds(kind, times) + fixed + wheel + poses(kind, "/odom", often))
    np.testing.assert_allclose(recording.world_from_lidar, expected_poses(times, BASE_FROM_LIDAR), atol=1e-5)
    assert recording.pose_source == "/odom (9 poses of base_link in odom, interpolated, moved to lidar by tf)"


def test_without_a_topic_of_poses_tf_is_one(tmp_path):
    """Even where its fixed transforms are said again and again, as ROS 1 did."""
    times, often = np.arange(5.0, 9.0, 0.1), np.arange(4.9, 9.2, 0.05)
    found = (
        lambda t: ("odom", "base_link", where(t), turned(t)),
        lambda t: ("base_link", "lidar", (1.0, 0.2, 1.5), QUARTER),
        lambda t: ("base_link", "arm", (t, 0.0, 0.0), (0, 0, 0, 1)),
    )
    recording = opened(tmp_path, "ros1", clouds("ros1", times) + tf("ros1", "/tf", often, *found))
    np.testing.assert_allclose(recording.world_from_lidar, expected_poses(times, BASE_FROM_LIDAR), atol=1e-5)
    said = "/tf/odom/base_link (86 poses of base_link in odom, interpolated, moved to lidar by tf)"
    assert recording.pose_source == said


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)])
def test_rotations_that_nobody_measured_are_none(tmp_path, quaternion):
    times = np.arange(5.0, 6.0, 0.1)
    track = poses("ros2", "/gps", times, turns=lambda t: quaternion)
    recording = opened(tmp_path, "ros2", clouds("ros2", times) + track)
    assert recording.world_from_lidar is None and len(recording.positions) == len(times)
    assert recording.pose_source.endswith("interpolated; its rotations are constant or missing)")


def stamps(header_s: np.ndarray, delay_s: float) -> Stamps:
    return Stamps(np.rint((header_s + delay_s) * 1e9).astype(np.int64), header_s)


@pytest.mark.parametrize(
    ("delay_s", "ahead_s", "phase_s", "used"),
    [
        (0.2, 37.0, 0.01, "recorder"),  # the LiDAR has the clock of PTP
        (4.0, 0.0, 0.01, "header"),
        (8.0, 0.0, 0.0, "header"),  # slow SLAM, with the times of the scans
        (900.0, 0.0, 0.01, "header"),  # another pass
    ],
)
def test_two_clocks_are_found_by_the_times_of_the_recorder(delay_s, ahead_s, phase_s, used):
    times = 1.7e9 + np.arange(0.0, 200.0, 0.5)
    scans = Stamps(stamps(times, 0.1).recorder_ns, times + ahead_s)
    poses = stamps(times + phase_s, delay_s)
    *found, problem = times_on_one_clock(poses, scans)
    if used == "recorder":
        np.testing.assert_array_equal(found, (poses.recorder_s, scans.recorder_s))
        assert "recorded 0.2 s after their header time, and scans -36.9 s after theirs" in problem
    else:
        np.testing.assert_array_equal(found, (poses.header_s, scans.header_s))
        assert not problem


def test_poses_of_a_lidar_on_another_clock_are_those_at_its_scans(tmp_path):
    times = np.arange(5.0, 105.0)
    ahead = [("/points", CLOUD, LATE_S + t, cloud("mcap", LATE_S + t + 37, points_of(0)[:4])) for t in times]
    often = np.arange(4.75, 106.0)
    track = [("/odom", ODOMETRY, LATE_S + t, pose("mcap", LATE_S + t, where(t), turned(t))) for t in often]
    with pytest.warns(DataWarning, match=r"/odom: .* recorded 0\.0 s after .*, and scans -37\.0 s after theirs"):
        recording = opened(tmp_path, "mcap", ahead + track)
    np.testing.assert_allclose(recording.positions, [where(t) for t in times], atol=1e-4)


def test_few_messages_may_come_late_but_a_clock_may_not_be_set_back():
    times = 100 + np.arange(4000) / 20
    scans, one_late = stamps(times, 0.3), times[np.r_[:50, 51:56, 50, 56:4000]]
    assert not Stamps(scans.recorder_ns, one_late).headers_are_valid()
    *found, _ = times_on_one_clock(Stamps(scans.recorder_ns, one_late), scans)
    np.testing.assert_array_equal(found, (one_late, times))
    overtaken = times[np.r_[:50, 52, 50, 51, 53:4000]]
    *found, _ = times_on_one_clock(Stamps(scans.recorder_ns, overtaken), scans)
    np.testing.assert_array_equal(found, (overtaken, times))
    slow = 1000.0 + np.arange(1000) - 5.0 * (np.arange(1000) >= 500)  # one message a second, set back by 5 s
    assert not stamps(slow, 0.3).headers_are_valid(most_late=0.01)
    set_back = np.where(times < 110, times, times - 1)
    *found, _ = times_on_one_clock(Stamps(scans.recorder_ns, set_back), scans)
    np.testing.assert_array_equal(found, (scans.recorder_s, scans.recorder_s))


def test_bags_of_two_days_are_two_recordings(tmp_path):
    times = np.arange(5.0, 7.0, 0.1)
    for day, (name, x) in enumerate({"monday": 0.0, "tuesday": 234.0}.items()):
        for part, some in enumerate((times[:10], times[10:])):
            clock = 86400.0 * day + some
            track = poses("ros1", "/odom", clock, at=lambda t, x=x: (x, t % 86400, 0.0))
            messages = sorted(clouds("ros1", clock) + track, key=lambda message: message[2])
            write_bag(tmp_path / f"{name}_{part}.bag", "ros1", messages)
    assert recording_names(tmp_path) == ("monday_0", "tuesday_0")
    for name, x in (("monday_0", 0.0), ("tuesday_0", 234.0)):
        recording = open_recording(tmp_path, name, sensor_height=1.7)
        assert len(recording) == 20
        np.testing.assert_allclose(recording.positions[:, 0], x)


def test_rotations_between_two_are_those_of_an_even_turn():
    stamps = np.array([2.0, 0.0, 1.0, 2.0])
    quaternions = np.stack([turned(t) for t in stamps]) * np.array([[1], [1], [-1], [1]])  # -q turns as q does
    times = np.array([-1.0, 0.0, 0.25, 1.0, 1.9, 2.5])
    given = poses_of(np.zeros((4, 3)), Rotation.from_quat(quaternions).as_matrix())
    true = Rotation.from_quat([turned(t) for t in times.clip(0, 2)])
    np.testing.assert_allclose(interpolate_poses(stamps, given, times)[:, :3, :3], true.as_matrix(), atol=1e-9)


def test_between_poses_far_apart_in_time_nothing_is_known():
    stamps, line = np.array([3.0, 0.0, 1.0, 3.5]), np.array([3.0, 0.0, 1.0, 3.5])[:, None] * [1.0, 2.0, 0.0]
    times = np.array([-0.2, -0.05, 0.5, 1.0, 2.0, 3.2, 3.55, 4.0, 3.0])
    assert have_poses(stamps, times).tolist() == [False, True, True, True, False, True, True, False, True]
    np.testing.assert_allclose(interpolate_poses(stamps, poses_of(line), times)[[2, 3, 5], 1, 3], [1.0, 2.0, 6.4])
    assert not have_poses(stamps[:1], times).any()
