"""Reads serialised ROS messages field by field. rosbags is slower, because it creates an object for each part.

ROS 1 packs the fields without padding, in little-endian order. ROS 2 (CDR) begins with four bytes that contain the byte
order. After them, each number is aligned to its size.
"""

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64, UInt8

from sglpr_jax.data.formats.clouds import check_points, cloud_scan
from sglpr_jax.data.imu import Imu
from sglpr_jax.data.poses import LEAST_SHARE, have_poses, poses_of
from sglpr_jax.data.scan import TIME_FIELDS, Scan, time_field_of
from sglpr_jax.data.times import time_unit_problem
from sglpr_jax.files import warn
from sglpr_jax.se3 import from_quaternions

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_LEAST_M, _MOST_M = 1e-3, 1e4
"""Range of most nonzero coordinates, in metres. Numbers in the other byte order are spread over 10**-38 to 10**38."""
_LASERS = ("ring", "channel", "line", "laser_id", "laser")
"""Field names that drivers use for the laser number of a point."""
CUSTOM_MSG = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")
POINT = {"offset_time": "u4", "x": "f4", "y": "f4", "z": "f4", "reflectivity": "u1", "tag": "u1", "line": "u1"}
"""Fields of a point, and their numpy types."""
UNIT = 0.01
"""Maximum deviation of the length of a quaternion from 1."""
IMU = "sensor_msgs/msg/Imu"
"""Message type of an IMU."""


class Header(NamedTuple):
    """std_msgs/Header: time in seconds, and frame."""

    time: float
    frame: str


class RosMessage:
    """A message and a read position. Reading beyond the end raises ValueError."""

    def __init__(self, raw: bytes, *, cdr: bool):
        self.raw = raw
        self._cdr = cdr
        self._order = ">" if cdr and not raw[1] & 1 else "<"
        self._at = 4 if cdr else 0

    def numbers(self, kind: str, count: int = 1) -> np.ndarray:
        """Read the next `count` numbers of a type such as "f8"."""
        dtype = np.dtype(f"{self._order}{kind}")
        return np.frombuffer(self._bytes(dtype.itemsize, count * dtype.itemsize), dtype)

    def text(self) -> str:
        """Read the next string."""
        length = int(self.numbers("u4")[0])
        return self._bytes(1, length).rstrip(b"\0").decode(errors="replace")

    def header(self) -> Header:
        """Read the header at the start of a sensor message."""
        if not self._cdr:
            self.numbers("u4")  # sequence number of ROS 1
        seconds, nanoseconds = int(self.numbers("i4")[0]), int(self.numbers("u4")[0])
        return Header(seconds + nanoseconds / 1e9, self.text())

    def records(self, fields: dict[str, str]) -> np.ndarray:
        """Read the next sequence of records. Fields of 4 bytes must precede fields of 1 byte."""
        count = int(self.numbers("u4")[0])
        layout = [(name, f"{self._order}{kind}") for name, kind in fields.items()]
        padding = -np.dtype(layout).itemsize % 4 if self._cdr else 0
        padded = np.dtype([*layout, ("padding", f"V{padding}")])
        content = self._bytes(4, max(count * padded.itemsize - padding, 0))  # the last record has no padding
        return np.frombuffer(content + bytes(padding if count else 0), padded)

    def _bytes(self, alignment: int, size: int) -> bytes:
        """Read the next bytes, in CDR from a multiple of `alignment` on."""
        start = self._at - ((self._at - 4) % -alignment if self._cdr else 0)
        self._at = start + size
        if self._at > len(self.raw):
            raise ValueError(f"expected a message of at least {self._at} bytes, found {len(self.raw)}")
        return self.raw[start : self._at]


def read_point_cloud2(message: Any, *, name: str = "cloud") -> Scan:
    """Return the points in the axes of a sensor_msgs/PointCloud2, and their lasers and times if it has such fields.

    Some drivers set `is_bigendian` for little-endian data. If only the little-endian numbers are metres, they are
    returned, with a warning that begins with `name`.
    """
    data = _point_bytes(message)
    records = data.view(_record(message, ">" if message.is_bigendian else "<"))
    if message.is_bigendian and not _in_metres(records):
        others = data.view(_record(message, "<"))
        if _in_metres(others):
            warn(f"{name}: expected big-endian points, as is_bigendian states, found little-endian points")
            records = others
    names = records.dtype.names or ()
    laser = next((field for field in _LASERS if field in names), None)
    return cloud_scan(records, time=time_field_of(names), laser=laser)


def _point_bytes(message: Any) -> UInt8[np.ndarray, " n"]:
    """Bytes of all points, without the padding of rows."""
    width, height, step, row = message.width, message.height, message.point_step, message.row_step
    check_points(width * height, bytes_each=step)
    row = max(row, width * step)
    data = np.frombuffer(bytes(message.data), np.uint8)
    if not step or len(data) < row * (height - 1) + width * step:
        raise ValueError(f"expected {height} rows of {width} points of {step} bytes, found {len(data)} bytes")
    return np.concatenate([data[start : start + width * step] for start in range(0, row * height, row)])


def _in_metres(records: np.ndarray) -> bool:
    """Whether most coordinates are those of a scan. Zeros and NaN are ignored."""
    size = np.abs(np.stack([records[axis].astype(np.float64) for axis in "xyz"]))
    size = size[size > 0]
    return not size.size or bool(np.mean((size >= _LEAST_M) & (size <= _MOST_M)) > 0.5)


def _record(message: Any, order: str) -> np.dtype:
    """Numpy type of a point with the coordinates, lasers and times of a PointCloud2, in a byte order."""
    fields = {field.name: field for field in message.fields}
    if not {"x", "y", "z"} <= set(fields):
        raise ValueError(f"expected the fields x, y and z, found {' '.join(fields) or 'none'}")
    names = [name for name in ("x", "y", "z", *_LASERS) if name in fields]
    names += [name for name in TIME_FIELDS if name in fields and fields[name].datatype in _TYPES]
    types = [_TYPES.get(fields[name].datatype) for name in names]
    if None in types:
        raise ValueError(f"expected numbers of types 1 to 8, found {[fields[name].datatype for name in names]}")
    formats, offsets = [f"{order}{kind}" for kind in types], [fields[name].offset for name in names]
    try:
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_step})
    except (ValueError, OverflowError) as error:
        raise ValueError(f"expected fields within {message.point_step} bytes, found others ({error})") from error


def read_custom_msg(message: RosMessage) -> Scan:
    """Return the points in the axes of a Livox message, their line numbers and their times."""
    message.header()
    for kind, count in (("u8", 1), ("u4", 1), ("u1", 4)):  # time base, number of points, LiDAR and reserved bytes
        message.numbers(kind, count)
    points = message.records(POINT)
    if not len(points):
        raise ValueError("expected at least one point, found none")
    return cloud_scan(points, time="offset_time", laser="line")


class StampedPose(NamedTuple):
    """Pose of a child frame in a frame, with its time."""

    time: float
    """Time in the header of the message, in seconds."""
    child: str
    """Child frame, such as "base_link". Empty if the message does not name it."""
    frame: str
    """Reference frame, such as "odom"."""
    numbers: Float[np.ndarray, " 7"]
    """Position x, y, z in metres, and quaternion x, y, z, w."""


def _pose(message: RosMessage, *, with_child: bool = True) -> StampedPose:
    header, child = message.header(), message.text() if with_child else ""
    return StampedPose(header.time, child, header.frame, message.numbers("f8", 7))


def read_transforms(message: RosMessage) -> Iterator[StampedPose]:
    """Read the transforms of a tf message. Each is the pose of its child frame in the frame of its header."""
    for _ in range(int(message.numbers("u4")[0])):
        yield _pose(message)


POSES: dict[str, Callable[[RosMessage], StampedPose]] = {
    "nav_msgs/msg/Odometry": _pose,
    "geometry_msgs/msg/PoseStamped": partial(_pose, with_child=False),
}
"""Message types with poses of the vehicle, and their readers."""
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""Message types of tf."""


class Stamps(NamedTuple):
    """Timestamps of the messages of a topic."""

    recorded: Int64[np.ndarray, " n"]
    """Times of the recorder, in nanoseconds."""
    own: Float[np.ndarray, " n"]
    """Times in the headers of the messages, in seconds."""

    @classmethod
    def of(cls, times: Iterable[tuple[int, float]]) -> "Stamps":
        """Stamps of messages from recorder times (ns) and header times (s)."""
        pairs = list(times)
        return cls(np.array([time for time, _ in pairs], np.int64), np.array([time for _, time in pairs], np.float64))

    @property
    def orderly(self) -> bool:
        """Whether the header times are positive, never decrease, and can be seconds (`times.time_unit_problem`)."""
        ordered = len(self.own) and (self.own > 0).all() and (np.diff(self.own) >= 0).all()
        return bool(ordered and not time_unit_problem(self.own, numbers=False))

    @property
    def seconds(self) -> Float[np.ndarray, " n"]:
        """Header times in seconds if they are orderly, or else the recorder's times."""
        return self.own if self.orderly else self.recorded / 1e9


@dataclasses.dataclass(frozen=True, eq=False)
class Track:
    """Poses of a topic."""

    stamps: Stamps
    numbers: Float[np.ndarray, "n 7"]
    """Positions in metres, and quaternions x, y, z, w. Quaternions are not normalised and may be invalid."""
    child: str
    """Child frame, such as "base_link". Empty if the messages do not name it."""
    frame: str
    """Reference frame, such as "odom"."""
    dropped: int = 0
    """Number of messages without a valid pose, which are not part of the track."""

    @classmethod
    def of(cls, messages: Iterable[tuple[int, StampedPose]]) -> "Track":
        """Create a track from recorder times (ns) and poses, without poses with non-finite positions.

        If most poses have a rotation, those without one are dropped, too.
        """
        pairs = list(messages)
        numbers = np.array([pose.numbers for _, pose in pairs], np.float64).reshape(-1, 7)
        valid = np.isfinite(numbers[:, :3]).all(axis=1)
        rotated = valid & _are_unit(numbers[:, 3:])
        rows = np.flatnonzero(rotated if 2 * rotated.sum() > valid.sum() else valid)
        stamps = Stamps.of((pairs[row][0], pairs[row][1].time) for row in rows)
        child, frame = (pairs[rows[0]][1].child, pairs[rows[0]][1].frame) if len(rows) else ("", "")
        return cls(stamps, numbers[rows], child, frame, len(pairs) - len(rows))

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def turned(self) -> bool:
        """Whether the messages contain rotations that change. A GPS receiver writes zeros or a constant."""
        return _turn(self.numbers[:, 3:])

    @property
    def poses(self) -> Float[np.ndarray, "n 4 4"]:
        """Poses, with identity rotations if not all quaternions are valid."""
        positions, quaternions = self.numbers[:, :3], self.numbers[:, 3:]
        return from_quaternions(positions, quaternions) if _are_unit(quaternions).all() else poses_of(positions)

    @property
    def moves(self) -> bool:
        """Whether any pose differs from the first."""
        return bool(len(self) and (self.numbers != self.numbers[0]).any())

    def __str__(self) -> str:
        return f"{len(self)} poses of {self.child or 'a body'} in {self.frame or 'a frame'}"


def _are_unit(quaternions: Float[np.ndarray, "n 4"]) -> Bool[np.ndarray, " n"]:
    """Whether each quaternion has length 1."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.abs(np.linalg.norm(quaternions, axis=1) - 1) <= UNIT


def _turn(quaternions: Float[np.ndarray, "n 4"]) -> bool:
    """Whether the quaternions are valid rotations that change."""
    return bool(len(quaternions) and _are_unit(quaternions).all() and np.ptp(quaternions, axis=0).any())


def tracks_of(transforms: Iterable[tuple[int, StampedPose]]) -> list[Track]:
    """Group tf transforms into one track for each pair of child and parent frame."""
    groups: dict[tuple[str, str], list[tuple[int, StampedPose]]] = defaultdict(list)
    for time, pose in transforms:
        child, frame = pose.child.strip("/"), pose.frame.strip("/")
        groups[child, frame].append((time, pose._replace(child=child, frame=frame)))
    return [Track.of(poses) for _, poses in sorted(groups.items())]


def times_on_one_clock(stamps: Stamps, scans: Stamps) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " q"]]:
    """Times of messages and of scans in seconds: header times, or recorder times if the headers do not overlap."""
    if scans.orderly and stamps.orderly and have_poses(stamps.own, scans.own).mean() >= LEAST_SHARE:
        return stamps.own, scans.own
    return stamps.recorded / 1e9, scans.recorded / 1e9


def fixed_transform(tracks: Iterable[Track], frame: str, other: str) -> Float[np.ndarray, "4 4"] | None:
    """Return the transform frame_from_other along static tracks, or None if no static tracks connect the two frames."""
    neighbours: dict[str, list[tuple[str, np.ndarray]]] = defaultdict(list)
    for track in tracks:
        if len(track) and not track.moves and _are_unit(track.numbers[:, 3:]).all():
            frame_from_child = track.poses[0]
            neighbours[track.frame].append((track.child, frame_from_child))
            neighbours[track.child].append((track.frame, np.linalg.inv(frame_from_child)))
    reached, queue = {frame: np.eye(4)}, [frame]
    for here in queue:
        for there, here_from_there in neighbours[here]:
            if there not in reached:
                reached[there] = reached[here] @ here_from_there
                queue.append(there)
    return reached.get(other)


def read_imu(messages: Iterable[tuple[int, RosMessage]]) -> tuple[Stamps, str, Imu]:
    """Decode timestamps, frame and samples of an IMU from its messages and the times (ns) of their recorder."""
    samples = [(time, message.header(), message.numbers("f8", 37)) for time, message in messages]
    numbers = np.array([numbers for _, _, numbers in samples], np.float64).reshape(-1, 37)
    quaternions, rates, accelerations = numbers[:, :4], numbers[:, 13:16], numbers[:, 25:28]
    known = _turn(quaternions) and numbers[0, 4] != -1  # the first covariance is -1 without orientation
    stamps = Stamps.of((time, header.time) for time, header, _ in samples)
    frame = next((header.frame for _, header, _ in samples if header.frame), "")
    return stamps, frame, Imu(stamps.own, rates, accelerations, quaternions if known else None)
