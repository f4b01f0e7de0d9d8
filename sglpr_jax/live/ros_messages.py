"""ROS messages as they travel: decoding of scans, encoding of loop edges, markers and transforms (CDR, XCDR1).

Messages are encoded by rosbags. Scans and poses are decoded by the readers of bags (`data.formats`).
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sglpr_jax.data.formats.ros_messages import CUSTOM_MSG, Header, RosMessage, read_custom_msg, read_point_cloud2
from sglpr_jax.data.record import Record
from sglpr_jax.files import in_short
from sglpr_jax.live.messages import LoopEdge
from sglpr_jax.se3 import quaternions

CLOUD = "sensor_msgs/msg/PointCloud2"
CLOUDS = (CLOUD, CUSTOM_MSG[1])
"""Types of scans: PointCloud2, and CustomMsg of livox_ros_driver2."""
EDGE = "geometry_msgs/msg/PoseWithCovarianceStamped"
MARKERS = "visualization_msgs/msg/MarkerArray"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
LIVOX_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
LIVOX = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\nCustomPoint[] points\n"
)
LINE_LIST = 5
"""Type of a marker that draws a line between each two points."""
LINE_M = 0.3
"""Width of the lines of loops, in metres."""


class Received(NamedTuple):
    """A message as it arrived."""

    kind: str
    """Type, such as "sensor_msgs/msg/PointCloud2"."""
    raw: bytes
    """The encoded message."""
    publisher: Any
    """Value that tells one publisher of the topic from others."""
    at: float
    """Time of arrival by `time.monotonic()`, in seconds."""


@functools.cache
def typestore() -> Any:
    """Definitions of messages by rosbags: those of ROS 2 Jazzy, and Livox's CustomMsg."""
    types = get_typestore(Stores.ROS2_JAZZY)
    for name, definition in (("CustomPoint", LIVOX_POINT), ("CustomMsg", LIVOX)):
        types.register(get_types_from_msg(definition, f"livox_ros_driver2/msg/{name}"))
    return types


def encode(message: Any) -> bytes:
    """Encode a message of `typestore`, with the four bytes of the encapsulation header."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def decode_cloud(raw: bytes, kind: str) -> tuple[Header, Record]:
    """Decode a scan, a message of one of the types `CLOUDS`.

    Raises ValueError if the message is damaged, or the cloud has no x, y and z.
    """
    try:
        header = RosMessage(raw, cdr=True).header()
        if kind == CLOUD:
            return header, read_point_cloud2(typestore().deserialize_cdr(raw, kind))
        return header, read_custom_msg(RosMessage(raw, cdr=True))
    except Exception as error:  # the sender defines the lengths, types and names of the fields
        raise ValueError(f"expected a cloud with points, found an invalid one ({in_short(error)})") from error


def edge_message(edge: LoopEdge) -> Any:
    """Loop edge as geometry_msgs/PoseWithCovarianceStamped.

    The stamp is the time of the query, and the frame is `match/SECONDS.NANOSECONDS`, with the time of the match. The
    pose is that of the query's LiDAR in the frame of the match's LiDAR. As ROS defines it, the covariance is along and
    about the axes of the match's frame: x, y, z in metres, then rotations about x, y, z in radians.
    """
    types = typestore().types
    turned = np.kron(np.eye(2), edge.match_from_query[:3, :3])
    covariance = turned @ edge.covariance @ turned.T
    seconds, nanoseconds = _split(edge.match_time)
    return types[EDGE](
        header=_header(edge.query_time, f"match/{seconds}.{nanoseconds:09d}"),
        pose=types["geometry_msgs/msg/PoseWithCovariance"](
            pose=_pose(edge.match_from_query), covariance=np.ascontiguousarray(covariance, np.float64).reshape(-1)
        ),
    )


def marker_message(ends: Sequence[Float[np.ndarray, "2 3"]], *, time: float, frame: str) -> Any:
    """Lines between the positions of the scans of each loop, as visualization_msgs/MarkerArray with one marker."""
    types = typestore().types
    point, colour = types["geometry_msgs/msg/Point"], types["std_msgs/msg/ColorRGBA"]
    nothing = types["std_msgs/msg/Header"](stamp=_stamp(0.0), frame_id="")
    marker = types["visualization_msgs/msg/Marker"](
        header=_header(time, frame),
        ns="loops",
        id=0,
        type=LINE_LIST,
        action=0,
        pose=_pose(np.eye(4)),
        scale=types["geometry_msgs/msg/Vector3"](x=LINE_M, y=0.0, z=0.0),
        color=colour(r=0.1, g=0.8, b=0.2, a=1.0),
        lifetime=types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0),
        frame_locked=False,
        points=[point(*map(float, end)) for pair in ends for end in pair],
        colors=[],
        texture_resource="",
        texture=types["sensor_msgs/msg/CompressedImage"](header=nothing, format="", data=np.zeros(0, np.uint8)),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=types["visualization_msgs/msg/MeshFile"](filename="", data=np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )
    return types[MARKERS](markers=[marker])


def transform_message(frame_from_child: Float[np.ndarray, "4 4"], *, time: float, frame: str, child: str) -> Any:
    """Pose of a child frame in a frame, as tf2_msgs/TFMessage."""
    types = typestore().types
    pose = _pose(frame_from_child)
    at = pose.position
    transform = types["geometry_msgs/msg/Transform"](
        translation=types["geometry_msgs/msg/Vector3"](x=at.x, y=at.y, z=at.z), rotation=pose.orientation
    )
    one = types["geometry_msgs/msg/TransformStamped"](
        header=_header(time, frame), child_frame_id=child, transform=transform
    )
    return types[TRANSFORMS](transforms=[one])


def _pose(frame_from_body: Float[np.ndarray, "4 4"]) -> Any:
    types = typestore().types
    x, y, z, w = map(float, quaternions(frame_from_body[None])[0])
    return types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](*map(float, frame_from_body[:3, 3])),
        orientation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
    )


def _header(time: float, frame: str) -> Any:
    return typestore().types["std_msgs/msg/Header"](stamp=_stamp(time), frame_id=frame)


def _stamp(time: float) -> Any:
    seconds, nanoseconds = _split(time)
    return typestore().types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)


def _split(time: float) -> tuple[int, int]:
    """Seconds and nanoseconds of a time. Times that no stamp can hold become 0."""
    if not math.isfinite(time) or not 0 <= time < 2**31:
        return 0, 0
    seconds, nanoseconds = divmod(round(time * 1e9), 10**9)
    return seconds, nanoseconds
