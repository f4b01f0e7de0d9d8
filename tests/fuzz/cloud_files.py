"""Scans in the formats of other programs: .ply, .npy, .npz, .las, compressed .pcd, and bags."""

import functools
import io
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from sglpr_jax.data.formats.scan_files import read_scan
from sglpr_jax.data.readers import open_recording

from .archives import npy, npz
from .damage import BYTES, Damage, declare, drop_word, extreme, flip_header
from .road import N, Road
from .rows import rows_text
from .scans_and_images import PCD_HEADER, POINTS

HEADED: dict[str, Damage] = {**BYTES, "declared": declare, "extreme": extreme, "header": flip_header}


def ply(order: str) -> bytes:
    """The points as a .ply file: in text, or in one of two byte orders."""
    named = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = f"ply\nformat {named} 1.0\nelement vertex {N}\n"
    header += "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity")) + "end_header\n"
    return header.encode() + (POINTS.astype(f"{order}f4").tobytes() if order else rows_text(POINTS))


def _same_ply(found: np.ndarray, content: bytes, *, order: str) -> bool:
    """What stands below the line of the end, four numbers a point."""
    lines = content.split(b"\n")
    end = next(i for i, line in enumerate(lines) if line.strip() == b"end_header")
    body = b"\n".join(lines[end + 1 :])
    if order:
        rows = np.frombuffer(body, f"{order}f4").reshape(-1, 4)
    else:
        rows = np.array([[float(word) for word in line.split()] for line in body.splitlines() if line.strip()])
    with np.errstate(all="ignore"):
        return np.array_equal(found, rows[:, :3].astype(np.float32), equal_nan=True)


def _same_array(found: np.ndarray, content: bytes) -> bool:
    with np.errstate(all="ignore"):
        array = np.load(io.BytesIO(content))
        array = array["points"] if isinstance(array, np.lib.npyio.NpzFile) else array
        return np.array_equal(found, array[:, :3].astype(np.float32), equal_nan=True)


def las() -> bytes:
    cloud = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    cloud.header.scales = [0.001] * 3
    cloud.x, cloud.y, cloud.z = POINTS[:, :3].astype(np.float64).T
    cloud.vlrs.append(laspy.VLR("mine", 7, "a record", b"12345"))
    stream = io.BytesIO()
    cloud.write(stream)
    return stream.getvalue()


def _same_las(found: np.ndarray, content: bytes) -> bool:
    """The integers of each record, scaled and moved as the header says."""
    (start,), (width,) = struct.unpack_from("<I", content, 96), struct.unpack_from("<H", content, 105)
    scales, offsets = np.frombuffer(content, "<f8", 6, 131).reshape(2, 3)
    records = np.frombuffer(content, np.uint8, width * N, start).reshape(N, width)
    with np.errstate(all="ignore"):
        points = np.ascontiguousarray(records[:, :12]).view("<i4") * scales + offsets
        return np.array_equal(found, points.astype(np.float32), equal_nan=True)


def pcd_compressed() -> bytes:
    """One run for each field."""
    packed = b"".join(bytes([len(column) * 4 - 1]) + column.tobytes() for column in POINTS.T.astype("<f4"))
    return PCD_HEADER + b"binary_compressed\n" + struct.pack("<II", len(packed), POINTS.nbytes) + packed


def _same_number(found: np.ndarray, content: bytes) -> bool:
    """Compressed points have no checksum: any points are right, if there are as many."""
    return found.shape == (N, 3)


def bag(kind: str) -> bytes:
    """A file of a bag with three clouds of different points."""
    one = kind == "bag"
    types = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("drive.bag" if one else "drive")
        storage = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        with Writer1(path) if one else Writer2(path, version=9, storage_plugin=storage) as writer:
            connection = writer.add_connection("/points", "sensor_msgs/msg/PointCloud2", typestore=types)
            serialize = types.serialize_ros1 if one else types.serialize_cdr
            for i in range(3):
                content = serialize(_message(types, i, seq={"seq": i} if one else {}), connection.msgtype)
                writer.write(connection, 10**9 * (200 + i), content)
        return (path if one else path / f"drive.{kind}").read_bytes()


def _message(types: Any, i: int, *, seq: dict[str, int]) -> Any:
    store = types.types
    time = store["builtin_interfaces/msg/Time"](sec=100 + i, nanosec=0)
    field = store["sensor_msgs/msg/PointField"]
    return store["sensor_msgs/msg/PointCloud2"](
        header=store["std_msgs/msg/Header"](stamp=time, frame_id="lidar", **seq),
        height=1,
        width=N,
        fields=[field(name=axis, offset=4 * at, datatype=7, count=1) for at, axis in enumerate("xyz")],
        is_bigendian=False,
        point_step=12,
        row_step=12 * N,
        data=np.frombuffer((POINTS[:, :3] + np.float32(i)).tobytes(), np.uint8),
        is_dense=True,
    )


def _read_bag(path: Path) -> list[np.ndarray]:
    recording = open_recording(path, sensor_height=1.73)
    return [recording.points(i) for i in range(len(recording))]


def _same_clouds(found: list[np.ndarray], content: bytes) -> bool:
    """Three clouds, whose points stand in the file."""
    return len(found) == 3 and all(points.astype("<f4").tobytes() in content for points in found)


def _ply_road(name: str, order: str) -> Road:
    same: Callable[[Any, bytes], bool] = functools.partial(_same_ply, order=order)
    text: dict[str, Damage] = {} if order else {"missing": functools.partial(drop_word, skip=8)}
    return Road(f"scan .ply, {name}", "1.ply", ply(order), read_scan, same, {**HEADED, **text})


ROADS = (
    _ply_road("ascii", ""),
    _ply_road("little", "<"),
    _ply_road("big", ">"),
    Road("scan .npy", "1.npy", npy(POINTS), read_scan, _same_array, HEADED),
    Road("scan .npz", "1.npz", npz({"points": POINTS}), read_scan, _same_array, HEADED),
    Road("scan .las", "1.las", las(), read_scan, _same_las, HEADED),
    Road("scan .pcd, packed", "1.pcd", pcd_compressed(), read_scan, _same_number, HEADED),
    *(
        Road(f"bag .{kind}", f"1.{kind}", bag(kind), _read_bag, _same_clouds, HEADED, cost=5)
        for kind in ("bag", "mcap", "db3")
    ),
)
