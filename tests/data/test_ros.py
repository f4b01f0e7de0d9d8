"""Bags of both ROSes and mcap, written here: times, several topics, none, broken files."""

import struct
import sys

import numpy as np
import pytest
from clouds import cloud, points_of
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from sglpr_jax.data.readers import open_recording, recording_names, ros
from sglpr_jax.data.scan_stream import readable


def write(
    path,
    kind,
    *,
    topics=("/velodyne_points",),
    scans=3,
    stamps=None,
    imu=False,
    compression=None,
    change=lambda i, c: c,
):
    """A bag with `scans` clouds on each topic, 0.1 s apart, each changed by `change`."""
    one = kind == "ros1"
    types = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    storage = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    writer = Writer1(path) if one else Writer2(path, version=9, storage_plugin=storage)
    if compression:
        writer.set_compression(*compression)
    with writer as bag:
        serialize = types.serialize_ros1 if one else types.serialize_cdr
        if imu:
            bag.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=types)
        for topic in topics:
            connection = bag.add_connection(topic, "sensor_msgs/msg/PointCloud2", typestore=types)
            for i in range(scans):
                message = ros_message(
                    types,
                    change(i, cloud(points_of(i), "ouster")),
                    100.0 + i / 10 if stamps is None else stamps[i],
                    one,
                )
                bag.write(connection, 10**9 * 200 + i * 10**8, serialize(message, connection.msgtype))
    return path


def ros_message(types, found, stamp, one):
    store = types.types
    field = store["sensor_msgs/msg/PointField"]
    time = store["builtin_interfaces/msg/Time"](sec=int(stamp), nanosec=round(stamp % 1 * 1e9))
    header = store["std_msgs/msg/Header"](stamp=time, frame_id="os_sensor", **({"seq": 7} if one else {}))
    return store["sensor_msgs/msg/PointCloud2"](
        header=header,
        height=found.height,
        width=found.width,
        fields=[field(name=f.name, offset=f.offset, datatype=f.datatype, count=1) for f in found.fields],
        is_bigendian=found.is_bigendian,
        point_step=found.point_step,
        row_step=found.row_step,
        data=found.data,
        is_dense=False,
    )


KINDS = {"ros1": "drive.bag", "ros2": "drive", "mcap": "drive"}


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_is_a_recording(tmp_path, kind):
    root = write(tmp_path / KINDS[kind], kind)
    assert recording_names(root) == ("drive",)
    recording = open_recording(root)
    assert recording.ids == ("000000", "000001", "000002") and recording.positions is None
    np.testing.assert_allclose(recording.times, [100, 100.1, 100.2])
    assert f"/velodyne_points of {root.name}, x y z intensity t ring (48 bytes a point)" in recording.found[0]
    for i in (2, 0, 1):
        record = recording.record(i, lasers=True)
        np.testing.assert_array_equal(record.points, points_of(i))
        np.testing.assert_array_equal(record.lasers, np.arange(24) % 16)
    assert recording.record(0).lasers is None


COMPRESSIONS = {
    "ros1, bz2": ("ros1", (Writer1.CompressionFormat.BZ2,)),
    "ros1, lz4": ("ros1", (Writer1.CompressionFormat.LZ4,)),
    "ros2, files": ("ros2", (CompressionMode.FILE, CompressionFormat.ZSTD)),
    "ros2, messages": ("ros2", (CompressionMode.MESSAGE, CompressionFormat.ZSTD)),
    "mcap, chunks": ("mcap", (CompressionMode.STORAGE, CompressionFormat.ZSTD)),
}


@pytest.mark.parametrize("name", COMPRESSIONS)
def test_compressed_bags(tmp_path, name):
    kind, compression = COMPRESSIONS[name]
    root = write(tmp_path / KINDS[kind], kind, compression=compression)
    recording = open_recording(root)
    for i in range(3):
        np.testing.assert_array_equal(recording.points(i), points_of(i))
    if kind == "ros1":
        return
    for path in root.glob("drive.*.zstd"):
        with pytest.raises(ValueError, match=r"drive\.\w+\.zstd: .* open the folder with .*drive/metadata\.yaml$"):
            open_recording(path)
    (root / "metadata.yaml").unlink()
    if name == "mcap, chunks":
        np.testing.assert_array_equal(open_recording(root).points(1), points_of(1))
    else:
        with pytest.raises(ValueError, match=r"drive\.(mcap|db3).*: expected .*metadata\.yaml is missing"):
            open_recording(root)


@pytest.mark.parametrize(("log", "lone"), [("wal", True), ("journal", False)])
def test_a_log_beside_a_bag_of_sqlite_is_named(tmp_path, log, lone):
    path = write(tmp_path / "drive", "ros2")
    (path / f"drive.db3-{log}").write_bytes(b"")
    assert len(open_recording(path)) == 3, "an empty log is left by a recorder that ended well"
    (path / f"drive.db3-{log}").write_bytes(b"messages")
    with pytest.raises(ValueError, match=rf"drive\.db3: expected a bag that its recorder has closed, found .*-{log} "):
        open_recording(path / "drive.db3" if lone else path)


@pytest.mark.parametrize("kind", ["ros2", "mcap"])
def test_a_recording_of_a_killed_recorder_has_no_metadata(tmp_path, kind):
    root = write(tmp_path / "drive", kind)
    (root / "metadata.yaml").unlink()
    for i in range(3):
        np.testing.assert_array_equal(open_recording(root).points(i), points_of(i))
    (file,) = root.iterdir()
    assert open_recording(file).name == "drive"
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"drive\.\w+: expected an intact ROS bag, .*metadata\.yaml is missing"):
        open_recording(root)
    (root / "metadata.yaml").touch()
    with pytest.raises(ValueError, match=r"drive: expected an intact ROS bag, .*; metadata\.yaml or a file that it"):
        open_recording(root)


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_an_empty_cloud_among_others_is_named_and_can_be_skipped(tmp_path, kind):
    def emptied(i, found):
        if i == 1:
            found.width, found.row_step, found.data = 0, 0, np.zeros(0, np.uint8)
        return found

    recording = open_recording(write(tmp_path / KINDS[kind], kind, change=emptied))
    np.testing.assert_array_equal(recording.points(2), points_of(2))
    with pytest.raises(ValueError, match=r"scan 000001: .*drive.*: expected a cloud with points on /velodyne_points"):
        recording.points(1)
    told = []
    assert readable(recording, on_bad_scan=lambda scan, error: told.append(scan)).ids == ("000000", "000002")
    assert told == ["000001"]


def test_fewer_messages_than_the_statistics_declare(tmp_path):
    root = write(tmp_path / "drive", "mcap")
    (root / "metadata.yaml").unlink()
    (file,) = root.iterdir()
    content = file.read_bytes()
    at = content.rindex(struct.pack("<IHQ", 10, 1, 3))  # messages of each channel: three of the first
    file.write_bytes(content[:at] + struct.pack("<IHQ", 10, 1, 4) + content[at + 14 :])
    with pytest.raises(
        ValueError, match=r"drive\.mcap: .*expected 4 messages on /velodyne_points by its statistics, f"
    ):
        open_recording(root)


def test_a_lone_mcap_and_folders_of_bags(tmp_path):
    folder = write(tmp_path / "drive", "mcap")
    lone = next(folder.glob("*.mcap")).rename(tmp_path / "lone.mcap")
    np.testing.assert_array_equal(open_recording(lone).points(1), points_of(1))
    parts = tmp_path / "parts"
    parts.mkdir()
    for i in range(2):
        write(parts / f"part{i}.bag", "ros1", stamps=[3 * i + 1, 3 * i + 2, 3 * i + 3])
    recording = open_recording(parts)
    assert recording.name == "parts" and len(recording) == 6


def test_times_that_go_back_are_the_recorders(tmp_path):
    root = write(tmp_path / "drive.bag", "ros1", stamps=[5.0, 4.0, 6.0])
    np.testing.assert_allclose(open_recording(root).times, [200, 200.1, 200.2])


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_several_topics_are_several_recordings(tmp_path, kind):
    root = write(tmp_path / KINDS[kind], kind, topics=("/ouster/points", "/livox"))
    assert recording_names(root) == ("livox", "ouster_points")
    with pytest.raises(FileNotFoundError, match="expected the name of one sequence, found livox, ouster_points"):
        open_recording(root)
    assert len(open_recording(root, "livox")) == 3


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_a_bag_without_clouds_lists_its_topics(tmp_path, kind):
    root = write(tmp_path / KINDS[kind], kind, topics=(), imu=True)
    with pytest.raises(ValueError, match=r"drive.*: expected a topic of point clouds .* found /imu \(sensor_msgs"):
        open_recording(root)


@pytest.mark.parametrize(("name", "content"), [("a.bag", b"#ROSBAG V2.0\n" + bytes(90)), ("a.mcap", b"")])
def test_broken_bags_are_named(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{name}: expected an intact ROS bag, found a broken one"):
        recording_names(tmp_path / name)


def test_without_the_extra_it_is_named(tmp_path, monkeypatch):
    root = write(tmp_path / "drive.bag", "ros1")
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(ImportError, match=r"drive\.bag: bags need the extra `ros`"):
        ros.recording_names(root)
