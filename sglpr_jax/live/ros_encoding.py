"""Encoding of loop edges, markers and transforms as ROS messages (CDR), and decoding of scans, for live ROS topics.

Messages are encoded by rosbags. `data.formats.ros_messages` decodes scans and poses, also those of bags.
"""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sglpr_jax.data.formats.ros_messages import CUSTOM_MSG, Header, RosMessage, read_custom_msg, read_point_cloud2
from sglpr_jax.data.scan import Scan
from sglpr_jax.files import in_short
from sglpr_jax.live.data_types import LoopEdge
from sglpr_jax.se3 import quaternions

CLOUD = "sensor_msgs/msg/PointCloud2"
CLOUD_TYPES = (CLOUD, CUSTOM_MSG[1])
"""Types of scans: PointCloud2, and CustomMsg of livox_ros_driver2."""
EDGE = "geometry_msgs/msg/PoseWithCovarianceStamped"
MARKERS = "visualization_msgs/msg/MarkerArray"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
LIVOX_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
LIVOX_CUSTOM_MSG = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\nCustomPoint[] points\n"
)
LINE_LIST = 5
"""Value of `type` of a marker that draws a line between points 0 and 1, 2 and 3, and so on."""
DELETE = 2
"""Value of `action` of a marker that deletes the earlier one. That of a marker that replaces it is 0."""
LINE_M = 0.3
"""Width of the lines of loops, in metres."""


class Received(NamedTuple):
    """A message as it arrived."""

    kind: str
    """Type, such as "sensor_msgs/msg/PointCloud2"."""
    raw: bytes
    """The encoded message."""
    publisher: Any
    """Value that identifies the publisher, or None if it is unknown."""
    at: float
    """Time of arrival by `time.monotonic()`, in seconds."""


@functools.cache
def typestore() -> Any:
    """Definitions of messages by rosbags: those of ROS 2 Jazzy, and Livox's CustomMsg."""
    types = get_typestore(Stores.ROS2_JAZZY)
    for name, definition in (("CustomPoint", LIVOX_POINT), ("CustomMsg", LIVOX_CUSTOM_MSG)):
        types.register(get_types_from_msg(definition, f"livox_ros_driver2/msg/{name}"))
    return types


def encode(kind: str, fields: Mapping[str, Any]) -> bytes:
    """Encode a message of a type, with the four bytes of the encapsulation header. Missing fields are zero or empty. A
    field that is a message is a mapping of its fields."""
    return bytes(typestore().serialize_cdr(_message(kind, fields), kind))


def _message(kind: str, fields: Mapping[str, Any]) -> Any:
    """Return the message object of rosbags. Missing fields are zero or empty."""

    def value(node: Any, definition: Any, content: Any) -> Any:
        """Return a field's value from its type (kind and definition of rosbags) and its content, None if missing."""
        if node.name == "NAME":
            return _message(definition, content or {})
        if node.name == "BASE":
            return content if content is not None else {"string": "", "bool": False}.get(definition[0], 0)
        (inner, inner_type), count = definition
        if inner.name == "NAME":
            return [_message(inner_type, element) for element in content or ()]
        return content if content is not None else np.zeros(count, inner_type[0])

    defined = typestore().fielddefs[kind][1]
    values = {name: value(node, of, fields.get(name)) for name, (node, of) in defined}
    return typestore().types[kind](**values)


def decode_cloud(raw: bytes, kind: str) -> tuple[Header, Scan]:
    """Decode a scan from a message of type `kind`, one of `CLOUD_TYPES`. Raises ValueError if the message is damaged,
    or the cloud has no x, y and z."""
    try:
        header = RosMessage(raw, cdr=True).header()
        if kind == CLOUD:
            return header, read_point_cloud2(typestore().deserialize_cdr(raw, kind))
        return header, read_custom_msg(RosMessage(raw, cdr=True))
    except Exception as error:  # the sender defines the lengths, types and names of the fields
        raise ValueError(f"expected a cloud with points, found an invalid one ({in_short(error)})") from error


def edge_message(edge: LoopEdge) -> bytes:
    """Encode a loop edge as geometry_msgs/PoseWithCovarianceStamped.

    The stamp is the time of the query, and the frame is `match/SECONDS.NANOSECONDS`, with the time of the match. The
    pose is that of the query's LiDAR in the frame of the match's LiDAR. As ROS defines it, the covariance is along and
    about the axes of the match's frame: x, y, z in metres, then rotations about x, y, z in radians.
    """
    # Block-diagonal: turns translations and rotations from the axes of the query to those of the match.
    rotation = np.kron(np.eye(2), edge.match_from_query[:3, :3])
    covariance = np.ascontiguousarray(rotation @ edge.covariance @ rotation.T, np.float64).reshape(-1)
    seconds, nanoseconds = _seconds_and_nanoseconds(edge.match_time)
    position, orientation = _position_and_quaternion(edge.match_from_query)
    pose = {"pose": {"position": position, "orientation": orientation}, "covariance": covariance}
    return encode(EDGE, {"header": header(edge.query_time, f"match/{seconds}.{nanoseconds:09d}"), "pose": pose})


def marker_message(ends: Sequence[Float[np.ndarray, "2 3"]], *, time: float, frame: str) -> bytes:
    """Encode lines between the positions of the two scans of each loop as a visualization_msgs/MarkerArray. Without
    loops, the message deletes earlier lines."""
    marker = {
        "header": header(time, frame),
        "ns": "loops",
        "type": LINE_LIST,
        "action": 0 if ends else DELETE,
        "pose": {"orientation": {"w": 1.0}},
        "scale": {"x": LINE_M},
        "color": {"r": 0.1, "g": 0.8, "b": 0.2, "a": 1.0},
        "points": [dict(zip("xyz", end.tolist(), strict=True)) for pair in ends for end in pair],
    }
    return encode(MARKERS, {"markers": [marker]})


def transform_message(frame_from_child: Float[np.ndarray, "4 4"], *, time: float, frame: str, child: str) -> bytes:
    """Encode the pose of the frame `child` in `frame` as tf2_msgs/TFMessage."""
    translation, rotation = _position_and_quaternion(frame_from_child)
    transform = {"translation": translation, "rotation": rotation}
    stamped = {"header": header(time, frame), "child_frame_id": child, "transform": transform}
    return encode(TRANSFORMS, {"transforms": [stamped]})


def header(time: float, frame: str) -> dict[str, Any]:
    """Return the fields of a std_msgs/Header."""
    seconds, nanoseconds = _seconds_and_nanoseconds(time)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}


def _position_and_quaternion(frame_from_body: Float[np.ndarray, "4 4"]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the fields x, y, z and x, y, z, w of a pose's position and quaternion."""
    position = frame_from_body[:3, 3].tolist()
    quaternion = quaternions(frame_from_body[None])[0].tolist()
    return dict(zip("xyz", position, strict=True)), dict(zip("xyzw", quaternion, strict=True))


def _seconds_and_nanoseconds(time: float) -> tuple[int, int]:
    """Return the seconds and nanoseconds of a time. Times that a ROS stamp cannot hold become 0."""
    if not math.isfinite(time) or not 0 <= time < 2**31:
        return 0, 0
    return divmod(round(time * 1e9), 10**9)
