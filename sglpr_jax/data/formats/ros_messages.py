"""Reads serialised ROS messages field by field. rosbags is slower, because it creates an object for each part.

ROS 1 packs the fields without padding, in little-endian order. A message of ROS 2 (CDR) begins with four bytes that
state the byte order. After them, each number is aligned to its size.
"""

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int64, UInt8

from sglpr_jax.data.formats.clouds import check_points, cloud_scan
from sglpr_jax.data.formats.pose_files import FARTHEST_POSITION_M
from sglpr_jax.data.imu import Imu
from sglpr_jax.data.poses import LEAST_SHARE, have_poses
from sglpr_jax.data.scan import LASER_FIELDS, TIME_FIELDS, Scan
from sglpr_jax.data.times import time_unit_problem
from sglpr_jax.files import warn
from sglpr_jax.se3 import from_quaternions, have_unit_length, poses_of

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Numpy types by the number `datatype` of sensor_msgs/PointField."""
_LEAST_M, _MOST_M = 1e-3, 1e4
"""Range of most nonzero coordinates, in metres. Numbers in the other byte order are spread over 10**-38 to 10**38."""
CUSTOM_MSG = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")
"""Message types of Livox scans."""
LIVOX_FIELDS = {"offset_time": "u4", "x": "f4", "y": "f4", "z": "f4", "reflectivity": "u1", "tag": "u1", "line": "u1"}
"""Fields of a point of Livox, and their numpy types."""
IMU = "sensor_msgs/msg/Imu"
"""Message type of an IMU."""
CLOCKS_APART_S = 5.0
"""Minimum difference between the delays of two topics, from header to recorder, if their clocks differ, in seconds.
Most SLAM programs are late by less."""
MOST_LATE = 0.01
"""Maximum fraction of messages whose header time is before that of an earlier message. More of them show a
clock that was set back."""


class Header(NamedTuple):
    """std_msgs/Header: time in seconds, and frame."""

    time: float
    frame: str


class RosMessage:
    """A serialised message of ROS 1 or (`cdr`) ROS 2. Its methods read part after part; ValueError beyond the end."""

    def __init__(self, raw: bytes, *, cdr: bool):
        self.raw = raw
        self._cdr = cdr
        self._byte_order = ">" if cdr and not raw[1] & 1 else "<"
        self._position = 4 if cdr else 0

    def numbers(self, number_type: str, count: int = 1) -> np.ndarray:
        """Read the next `count` numbers of a numpy type such as "f8"."""
        dtype = np.dtype(f"{self._byte_order}{number_type}")
        return np.frombuffer(self._bytes(dtype.itemsize, count * dtype.itemsize), dtype)

    def text(self) -> str:
        """Read the next string."""
        length = int(self.numbers("u4")[0])
        return self._bytes(1, length).rstrip(b"\0").decode(errors="replace")

    def header(self) -> Header:
        """Read the header at the start of a sensor message, without slashes at the ends of the frame (ROS 1)."""
        if not self._cdr:
            self.numbers("u4")  # sequence number of ROS 1
        seconds, nanoseconds = int(self.numbers("i4")[0]), int(self.numbers("u4")[0])
        return Header(seconds + nanoseconds / 1e9, self.text().strip("/"))

    def records(self, fields: dict[str, str]) -> np.ndarray:
        """Read the next sequence of records as a structured array. Fields of 4 bytes must precede fields of 1 byte."""
        count = int(self.numbers("u4")[0])
        layout = [(name, f"{self._byte_order}{number_type}") for name, number_type in fields.items()]
        padding = -np.dtype(layout).itemsize % 4 if self._cdr else 0  # to 4 bytes after each record but the last
        padded = np.dtype([*layout, ("padding", f"V{padding}")])
        content = self._bytes(4, max(count * padded.itemsize - padding, 0))
        return np.frombuffer(content + bytes(padding if count else 0), padded)

    def _bytes(self, alignment: int, size: int) -> bytes:
        """Read the next `size` bytes. In CDR, they start at a multiple of `alignment` after the first 4 bytes."""
        padding = (4 - self._position) % alignment if self._cdr else 0
        start = self._position + padding
        self._position = start + size
        if self._position > len(self.raw):
            raise ValueError(f"expected a message of at least {self._position} bytes, found {len(self.raw)}")
        return self.raw[start : self._position]


def read_point_cloud2(message: Any, *, name: str = "cloud") -> Scan:
    """Return the points of a sensor_msgs/PointCloud2 in its axes, with laser numbers and times if it has such fields.

    Some drivers set `is_bigendian` for little-endian data. If only the little-endian numbers are metres, they are
    returned, with a warning that begins with `name`.
    """
    data = _point_bytes(message)
    points = data.view(_point_type(message, ">" if message.is_bigendian else "<"))
    if message.is_bigendian and not _in_metres(points):
        swapped = data.view(_point_type(message, "<"))
        if _in_metres(swapped):
            warn(f"{name}: expected big-endian points, as is_bigendian states, found little-endian points")
            points = swapped
    return cloud_scan(points)


def _point_bytes(message: Any) -> UInt8[np.ndarray, " n"]:
    """Return the bytes of all points of a PointCloud2, without the padding between the rows of its image."""
    width, height, point_bytes = message.width, message.height, message.point_step
    check_points(width * height, bytes_each=point_bytes)
    row_bytes = max(message.row_step, width * point_bytes)
    data = np.frombuffer(bytes(message.data), np.uint8)
    if not point_bytes or len(data) < row_bytes * (height - 1) + width * point_bytes:
        raise ValueError(f"expected {height} rows of {width} points of {point_bytes} bytes, found {len(data)} bytes")
    starts = range(0, row_bytes * height, row_bytes)
    return np.concatenate([data[start : start + width * point_bytes] for start in starts])


def _in_metres(points: np.ndarray) -> bool:
    """Whether most coordinates are between 1 mm and 10 km. Zeros and NaN are ignored."""
    size = np.abs(np.stack([points[axis].astype(np.float64) for axis in "xyz"]))
    size = size[size > 0]
    return not size.size or bool(np.mean((size >= _LEAST_M) & (size <= _MOST_M)) > 0.5)


def _point_type(message: Any, byte_order: str) -> np.dtype:
    """Return the numpy type of a point of a PointCloud2, with the fields for coordinates, laser number and time."""
    fields = {field.name: field for field in message.fields}
    if not {"x", "y", "z"} <= set(fields):
        raise ValueError(f"expected the fields x, y and z, found {' '.join(fields) or 'none'}")
    names = [name for name in ("x", "y", "z", *LASER_FIELDS) if name in fields]
    names += [name for name in TIME_FIELDS if name in fields and fields[name].datatype in _TYPES]
    datatypes = [fields[name].datatype for name in names]
    if not set(datatypes) <= set(_TYPES):
        raise ValueError(f"expected numbers of types 1 to 8, found {datatypes}")
    formats = [f"{byte_order}{_TYPES[datatype]}" for datatype in datatypes]
    offsets = [fields[name].offset for name in names]
    try:
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_step})
    except (ValueError, OverflowError) as error:
        raise ValueError(f"expected fields within {message.point_step} bytes, found others ({error})") from error


def read_custom_msg(message: RosMessage) -> Scan:
    """Return the points of a Livox message in its axes, with their line numbers and times."""
    message.header()
    for number_type, count in (("u8", 1), ("u4", 1), ("u1", 4)):  # skip time base, point count, LiDAR and reserved
        message.numbers(number_type, count)
    points = message.records(LIVOX_FIELDS)
    if not len(points):
        raise ValueError("expected at least one point, found none")
    return cloud_scan(points)


class StampedPose(NamedTuple):
    """Pose of a child frame, such as that of the robot, in a reference frame."""

    time: float
    """Time in the header of the message, in seconds."""
    child: str
    """Child frame, such as "base_link". Empty if the message does not name it."""
    frame: str
    """Reference frame, such as "odom"."""
    numbers: Float[np.ndarray, " 7"]
    """Position x, y, z in metres, and quaternion x, y, z, w."""

    @property
    def is_valid(self) -> bool:
        """Whether the position is on the Earth, and the quaternion has length 1. Some drivers begin with zeros."""
        is_on_earth = bool((np.abs(self.numbers[:3]) <= FARTHEST_POSITION_M).all())  # False for NaN
        return is_on_earth and bool(have_unit_length(self.numbers[None, 3:]).all())


def _read_pose(message: RosMessage, *, with_child: bool = True) -> StampedPose:
    """Read header, child frame (unless the message type has none), position and quaternion."""
    header = message.header()
    child = message.text().strip("/") if with_child else ""
    return StampedPose(header.time, child, header.frame, message.numbers("f8", 7))


def read_transforms(message: RosMessage) -> Iterator[StampedPose]:
    """Read the transforms of a tf message. Each is the pose of its child frame in the frame of its header."""
    for _ in range(int(message.numbers("u4")[0])):
        yield _read_pose(message)


POSES: dict[str, Callable[[RosMessage], StampedPose]] = {
    "nav_msgs/msg/Odometry": _read_pose,
    "geometry_msgs/msg/PoseStamped": partial(_read_pose, with_child=False),
}
"""Message types with poses of the vehicle, and their readers."""
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""Message types of tf."""


class Stamps(NamedTuple):
    """Timestamps of the messages of a topic."""

    recorder_ns: Int64[np.ndarray, " n"]
    """Times at which the recorder received the messages, in nanoseconds."""
    header_s: Float[np.ndarray, " n"]
    """Times in the headers of the messages, in seconds."""

    @classmethod
    def of(cls, times: Iterable[tuple[int, float]]) -> "Stamps":
        """Create stamps from a recorder time (ns) and a header time (s) for each message."""
        pairs = list(times)
        return cls(np.array([pair[0] for pair in pairs], np.int64), np.array([pair[1] for pair in pairs], np.float64))

    @property
    def recorder_s(self) -> Float[np.ndarray, " n"]:
        """Times at which the recorder received the messages, in seconds."""
        return self.recorder_ns / 1e9

    @property
    def delay_s(self) -> float:
        """Median time from header to recorder, in seconds."""
        return float(np.median(self.recorder_s - self.header_s))

    def headers_are_valid(self, *, most_late: float = 0.0) -> bool:
        """Whether the header times are positive and can be seconds (`times.time_unit_problem`), and at most the
        fraction `most_late` of them is before the time of an earlier message. Two early messages before two late ones
        show a clock that was set back."""
        if not len(self.header_s) or not (self.header_s > 0).all():
            return False
        is_late = self.header_s < np.maximum.accumulate(self.header_s)
        is_early = self.header_s > np.minimum.accumulate(self.header_s[::-1])[::-1]
        is_set_back = (is_early[:-3] & is_early[1:-2] & is_late[2:-1] & is_late[3:]).any()
        if is_late.mean() > most_late or is_set_back:
            return False
        return not time_unit_problem(np.sort(self.header_s), numbers=False)

    @property
    def seconds(self) -> Float[np.ndarray, " n"]:
        """Header times in seconds if all are valid, or else the recorder's times."""
        return self.header_s if self.headers_are_valid() else self.recorder_s


@dataclasses.dataclass(frozen=True, eq=False)
class Track:
    """Poses of one child frame in one reference frame, from the messages of a topic."""

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
        """Create a track from a recorder time (ns) and a pose for each message.

        Poses whose position is not on the Earth are dropped. If most poses have a rotation (a quaternion of length 1),
        poses without a rotation are dropped, too.
        """
        pairs = list(messages)
        numbers = np.array([pose.numbers for _, pose in pairs], np.float64).reshape(-1, 7)
        has_position = (np.abs(numbers[:, :3]) <= FARTHEST_POSITION_M).all(axis=1)  # False for NaN
        has_rotation = has_position & have_unit_length(numbers[:, 3:])
        rows = np.flatnonzero(has_rotation if 2 * has_rotation.sum() > has_position.sum() else has_position)
        kept = [pairs[row] for row in rows]
        stamps = Stamps.of((recorder_ns, pose.time) for recorder_ns, pose in kept)
        child, frame = (kept[0][1].child, kept[0][1].frame) if kept else ("", "")
        return cls(stamps, numbers[rows], child, frame, dropped=len(pairs) - len(rows))

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def rotates(self) -> bool:
        """Whether all poses have a rotation and the rotations change. A GPS receiver writes zeros or a constant."""
        return _are_changing_rotations(self.numbers[:, 3:])

    @property
    def poses(self) -> Float[np.ndarray, "n 4 4"]:
        """Poses, with identity rotations if not all quaternions are valid."""
        positions, quaternions = self.numbers[:, :3], self.numbers[:, 3:]
        return from_quaternions(positions, quaternions) if have_unit_length(quaternions).all() else poses_of(positions)

    @property
    def moves(self) -> bool:
        """Whether any pose differs from the first."""
        return bool(len(self) and (self.numbers != self.numbers[0]).any())

    def __str__(self) -> str:
        return f"{len(self)} poses of {self.child or 'a body'} in {self.frame or 'a frame'}"


def _are_changing_rotations(quaternions: Float[np.ndarray, "n 4"]) -> bool:
    return bool(len(quaternions) and have_unit_length(quaternions).all() and np.ptp(quaternions, axis=0).any())


def tracks_of_transforms(transforms: Iterable[tuple[int, StampedPose]]) -> list[Track]:
    """Group tf transforms, each with its recorder time (ns), into a track for each pair of child and parent frame."""
    groups: dict[tuple[str, str], list[tuple[int, StampedPose]]] = defaultdict(list)
    for recorder_ns, pose in transforms:
        groups[pose.child, pose.frame].append((recorder_ns, pose))
    return [Track.of(poses) for _, poses in sorted(groups.items())]


def times_on_one_clock(messages: Stamps, scans: Stamps) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " q"], str]:
    """Return the times of messages, in any order, and of scans in seconds: header times if they have one clock, or else
    recorder times. If header times overlap but have two clocks, the last value describes it. Otherwise it is empty."""
    valid = scans.headers_are_valid() and messages.headers_are_valid(most_late=MOST_LATE)
    if not valid or have_poses(messages.header_s, scans.header_s).mean() < LEAST_SHARE:
        return messages.recorder_s, scans.recorder_s, ""
    if abs(messages.delay_s - scans.delay_s) <= CLOCKS_APART_S:
        return messages.header_s, scans.header_s, ""
    # Messages of a slow SLAM program are late, but most such programs copy the times of the scans. Messages of another
    # pass were recorded after the scans.
    are_copied = np.isin(messages.header_s, scans.header_s).mean() >= LEAST_SHARE
    if are_copied or have_poses(messages.recorder_s, scans.recorder_s).mean() < LEAST_SHARE:
        return messages.header_s, scans.header_s, ""
    problem = (
        f"expected header times on the clock of the scans, found messages recorded {messages.delay_s:.1f} s after "
        f"their header time, and scans {scans.delay_s:.1f} s after theirs; the times of the recorder are used, which "
        "are wrong if the messages were computed late"
    )
    return messages.recorder_s, scans.recorder_s, problem


def static_transform(tracks: Iterable[Track], frame: str, other: str) -> Float[np.ndarray, "4 4"] | None:
    """Return the transform frame_from_other along static tracks, or None if no static tracks connect the two frames."""
    neighbours: dict[str, list[tuple[str, np.ndarray]]] = defaultdict(list)
    for track in tracks:
        if len(track) and not track.moves and have_unit_length(track.numbers[:, 3:]).all():
            frame_from_child = track.poses[0]
            neighbours[track.frame].append((track.child, frame_from_child))
            neighbours[track.child].append((track.frame, np.linalg.inv(frame_from_child)))
    frame_from: dict[str, np.ndarray] = {frame: np.eye(4)}
    queue = [frame]  # breadth-first search, which appends to the queue
    for current in queue:
        for neighbour, current_from_neighbour in neighbours[current]:
            if neighbour not in frame_from:
                frame_from[neighbour] = frame_from[current] @ current_from_neighbour
                queue.append(neighbour)
    return frame_from.get(other)


def read_imu(messages: Iterable[tuple[int, RosMessage]]) -> tuple[Stamps, str, Imu]:
    """Decode timestamps, frame and samples of an IMU from sensor_msgs/Imu messages and their recorder times (ns)."""
    samples = [(recorder_ns, message.header(), message.numbers("f8", 37)) for recorder_ns, message in messages]
    # Orientation and its covariance (4 + 9 numbers), angular velocity (3 + 9), linear acceleration (3 + 9).
    numbers = np.array([numbers for _, _, numbers in samples], np.float64).reshape(-1, 37)
    quaternions, rates, accelerations = numbers[:, :4], numbers[:, 13:16], numbers[:, 25:28]
    has_orientation = _are_changing_rotations(quaternions) and numbers[0, 4] != -1  # ROS: -1 means unknown
    stamps = Stamps.of((recorder_ns, header.time) for recorder_ns, header, _ in samples)
    frame = next((header.frame for _, header, _ in samples if header.frame), "")
    return stamps, frame, Imu(stamps.header_s, rates, accelerations, quaternions if has_orientation else None)
