"""Bags of both ROSes and mcap, written here: every driver's fields, times, several topics, none, broken files."""

import struct
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from sglpr_jax.data import open_recording, recording_names
from sglpr_jax.data.formats import inflation
from sglpr_jax.data.formats.point_cloud2 import described_fields, read_point_cloud2
from sglpr_jax.data.readable import readable
from sglpr_jax.data.readers import ros
from sglpr_jax.data.warning import DataWarning

CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
DRIVERS = {
    "velodyne": (22, {"x": (0, "f4"), "y": (4, "f4"), "z": (8, "f4"), "intensity": (12, "f4"), "ring": (16, "u2")}),
    "velodyne, padded": (32, {"x": (0, "f4"), "y": (4, "f4"), "z": (8, "f4"), "ring": (20, "u2"), "time": (24, "f4")}),
    "ouster": (
        48,
        {"x": (0, "f4"), "y": (4, "f4"), "z": (8, "f4"), "intensity": (16, "f4"), "t": (20, "u4"), "ring": (26, "u1")},
    ),
    "hesai": (
        34,
        {"x": (0, "f4"), "y": (4, "f4"), "z": (8, "f4"), "timestamp": (18, "f8"), "ring": (26, "u2")},
    ),
    "livox": (26, {"x": (0, "f4"), "y": (4, "f4"), "z": (8, "f4"), "tag": (16, "u1"), "line": (17, "u1")}),
    "turned about": (41, {"ring": (0, "u1"), "z": (1, "f8"), "x": (17, "f8"), "y": (33, "f8")}),
}


def cloud(points, driver="velodyne", *, order="<", height=1, padding=0):
    """What a message holds: the points as this driver lays them out, in `height` rows, each followed by padding."""
    step, layout = DRIVERS[driver]
    kinds = {"names": list(layout), "formats": [order + kind for _, kind in layout.values()]}
    records = np.full(len(points) * step, 0xAB, np.uint8).view(
        np.dtype({**kinds, "offsets": [offset for offset, _ in layout.values()], "itemsize": step})
    )
    for axis, column in zip("xyz", points.T, strict=True):
        records[axis] = column
    laser = "line" if driver == "livox" else "ring"
    records[laser] = np.arange(len(points)) % 16
    rows = np.frombuffer(records.tobytes(), np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xCD)
    return SimpleNamespace(
        fields=[SimpleNamespace(name=n, offset=o, datatype=CODES[k], count=1) for n, (o, k) in layout.items()],
        is_bigendian=order == ">",
        point_step=step,
        row_step=rows.shape[1],
        width=len(points) // height,
        height=height,
        data=rows.reshape(-1),
    )


def points_of(scan: int, n: int = 24) -> np.ndarray:
    points = np.random.default_rng(scan).normal(scale=9, size=(n, 3)).astype(np.float32)
    points[3] = np.nan
    return points


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(("height", "padding"), [(1, 0), (4, 0), (4, 10)])
def test_every_driver(driver, order, height, padding):
    found = read_point_cloud2(cloud(points_of(0), driver, order=order, height=height, padding=padding))
    np.testing.assert_array_equal(found.points, points_of(0))
    np.testing.assert_array_equal(found.lasers, np.arange(24) % 16)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 25}, "expected 1 rows of 25 points of 22 bytes, found 528 bytes"),
        ({"width": 0}, "expected at least one point, found none"),
        ({"fields": []}, "expected the fields x, y and z, found none"),
        ({"point_step": 6}, "expected fields within 6 bytes, found others"),
    ],
)
def test_broken_clouds(change, message):
    broken = cloud(points_of(0))
    vars(broken).update(change)
    with pytest.raises(ValueError, match=message):
        read_point_cloud2(broken)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "expected a scan of at most 16777216 points, found 1844674"),
        ({"width": 2**20, "point_step": 2**31}, "expected a scan of at most 536870912 bytes"),
        ({"point_step": 0, "row_step": 0}, "expected 1 rows of 24 points of 0 bytes, found 528 bytes"),
    ],
)
def test_sizes_that_no_cloud_has(change, message):
    broken = cloud(points_of(0))
    vars(broken).update(change)
    with pytest.raises(ValueError, match=message):
        read_point_cloud2(broken)


def test_an_offset_beyond_every_size():
    broken = cloud(points_of(0))
    broken.fields[0].offset = 2**32 - 1
    with pytest.raises(ValueError, match="expected fields within 22 bytes, found others"):
        read_point_cloud2(broken)


@pytest.mark.parametrize("driver", ["velodyne", "turned about"])
def test_a_big_endian_flag_on_little_endian_points(driver):
    flagged = cloud(points_of(0), driver)
    flagged.is_bigendian = True
    with pytest.warns(DataWarning, match=r"drive: expected big-endian points, as is_bigendian states, found little"):
        found = read_point_cloud2(flagged, name="drive")
    np.testing.assert_array_equal(found.points, points_of(0))
    np.testing.assert_array_equal(found.lasers, np.arange(24) % 16)


def test_lasers_that_are_no_numbers():
    """A ring of float32, as some converters write it."""
    with_ring = cloud(points_of(0))
    with_ring.fields[-1].datatype, with_ring.fields[-1].offset = CODES["f4"], 12
    records = with_ring.data.view(np.dtype({"names": ["r"], "formats": ["<f4"], "offsets": [12], "itemsize": 22}))
    records["r"] = [np.nan, *range(1, 24)]
    np.testing.assert_array_equal(read_point_cloud2(with_ring).lasers[1:], np.arange(1, 24))


def test_fields_of_other_types_are_refused():
    broken = cloud(points_of(0))
    broken.fields[0].datatype = 9
    with pytest.raises(ValueError, match=r"expected numbers of types 1 to 8, found \[9, 7, 7, 4\]"):
        read_point_cloud2(broken)
    assert described_fields(broken) == "x y z intensity ring (22 bytes a point)"


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
    "mcap, files": ("mcap", (CompressionMode.FILE, CompressionFormat.ZSTD)),
    "mcap, messages": ("mcap", (CompressionMode.MESSAGE, CompressionFormat.ZSTD)),
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


@pytest.mark.parametrize("name", COMPRESSIONS)
def test_parts_that_inflate_beyond_the_bound_are_refused(tmp_path, name, monkeypatch):
    kind, compression = COMPRESSIONS[name]
    path = write(tmp_path / KINDS[kind], kind, compression=compression)
    monkeypatch.setattr(inflation, "MOST_BYTES", 100)
    monkeypatch.setattr(inflation, "INFLATION", 1)
    most = "1 times the size" if "files" in name else "100 "
    with pytest.raises(ValueError, match=rf"expected an intact ROS bag, found .*at most {most}"):
        open_recording(path)


@pytest.mark.parametrize("log", ["wal", "journal"])
@pytest.mark.parametrize("lone", [True, False])
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


@pytest.mark.parametrize("kind", KINDS)
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


def test_messages_of_one_time_are_told_apart(tmp_path):
    parts = tmp_path / "parts"
    parts.mkdir()
    for i in range(2):  # both bags record at the same nanoseconds
        write(parts / f"part{i}.bag", "ros1", scans=1)
    recording = open_recording(parts)
    assert len(recording) == 2
    np.testing.assert_array_equal(recording.points(1), points_of(0))


def test_times_that_go_back_are_the_recorders(tmp_path):
    root = write(tmp_path / "drive.bag", "ros1", stamps=[5.0, 4.0, 6.0])
    np.testing.assert_allclose(open_recording(root).times, [200, 200.1, 200.2])


@pytest.mark.parametrize("kind", KINDS)
def test_several_topics_are_several_recordings(tmp_path, kind):
    root = write(tmp_path / KINDS[kind], kind, topics=("/ouster/points", "/livox"))
    assert recording_names(root) == ("livox", "ouster_points")
    with pytest.raises(FileNotFoundError, match="expected the name of one sequence, found livox, ouster_points"):
        open_recording(root)
    assert len(open_recording(root, "livox")) == 3


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_without_clouds_lists_its_topics(tmp_path, kind):
    root = write(tmp_path / KINDS[kind], kind, topics=(), imu=True)
    with pytest.raises(ValueError, match=r"drive.*: expected a topic of point clouds .* found /imu \(sensor_msgs"):
        open_recording(root)


@pytest.mark.parametrize("kind", KINDS)
def test_a_topic_without_messages(tmp_path, kind):
    root = write(tmp_path / KINDS[kind], kind, scans=0)
    with pytest.raises(ValueError, match="expected point clouds on /velodyne_points, found no message"):
        open_recording(root)


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
@pytest.mark.parametrize("content", [b"", b"no bag at all", b"#ROSBAG V2.0\n" + bytes(90)])
def test_broken_bags_are_named(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{name}: expected an intact ROS bag, found a broken one"):
        recording_names(tmp_path / name)


def test_without_the_extra_it_is_named(tmp_path, monkeypatch):
    root = write(tmp_path / "drive.bag", "ros1")
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(ImportError, match=r"drive\.bag: bags need the extra `ros`"):
        ros.recording_names(root)
