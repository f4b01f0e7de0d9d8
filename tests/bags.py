"""Bags of both ROSes and mcap for the tests: messages of any type at any time."""

import functools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sglpr_jax.live.ros_encoding import LIVOX_CUSTOM_MSG, LIVOX_POINT

LIVOX_DRIVERS = ("livox_ros_driver", "livox_ros_driver2")
CODES = {"u1": 2, "u2": 4, "u4": 6, "f4": 7, "f8": 8}
"""Codes of PointField by numpy type."""
CLOUD = "sensor_msgs/msg/PointCloud2"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
FILES = {"ros1": "drive.bag", "ros2": "drive", "mcap": "drive"}
"""What a bag of each kind is called."""


@functools.cache
def typestore(kind: str) -> Any:
    """The messages of a ROS, with those of tf and of both drivers of Livox."""
    types = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    for package in LIVOX_DRIVERS:
        types.register(get_types_from_msg(LIVOX_POINT, f"{package}/msg/CustomPoint"))
        types.register(get_types_from_msg(LIVOX_CUSTOM_MSG, f"{package}/msg/CustomMsg"))
    if kind == "ros1":
        types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", TRANSFORMS))
    return types


def header(kind: str, seconds: float, frame: str) -> Any:
    """A header at this time."""
    store = typestore(kind).types
    stamp = store["builtin_interfaces/msg/Time"](sec=int(seconds), nanosec=round(seconds % 1 * 1e9))
    return store["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **({"seq": 7} if kind == "ros1" else {}))


def transforms(kind: str, seconds: float, found: Iterable[tuple[str, str, Any, Any]]) -> Any:
    """A message of tf: frame, child, position and quaternion (x, y, z, w) of each transform, at this time."""
    store = typestore(kind).types
    one = store["geometry_msgs/msg/TransformStamped"]
    return store[TRANSFORMS](
        transforms=[
            one(
                header=header(kind, seconds, frame),
                child_frame_id=child,
                transform=store["geometry_msgs/msg/Transform"](
                    translation=store["geometry_msgs/msg/Vector3"](*map(float, at)),
                    rotation=store["geometry_msgs/msg/Quaternion"](*map(float, turned)),
                ),
            )
            for frame, child, at, turned in found
        ]
    )


def cloud(kind: str, seconds: float, points: np.ndarray, **more: np.ndarray) -> Any:
    """A PointCloud2 of x, y, z and more fields at this time."""
    store = typestore(kind).types
    columns = {**dict(zip("xyz", np.asarray(points, "<f4").T, strict=True)), **more}
    records = np.rec.fromarrays(list(columns.values()), names=list(columns))
    field = store["sensor_msgs/msg/PointField"]
    layout = {name: (records.dtype[name].str[1:], records.dtype.fields[name][1]) for name in columns}
    return store[CLOUD](
        header=header(kind, seconds, "lidar"),
        height=1,
        width=len(points),
        fields=[field(name=name, offset=at, datatype=CODES[of], count=1) for name, (of, at) in layout.items()],
        is_bigendian=False,
        point_step=records.itemsize,
        row_step=records.nbytes,
        data=np.frombuffer(records.tobytes(), np.uint8),
        is_dense=True,
    )


def livox(
    kind: str, seconds: float, points: np.ndarray, *, driver: str = LIVOX_DRIVERS[0], frame: str = "livox"
) -> Any:
    """Livox's own message, with six lines."""
    store = typestore(kind).types
    point = store[f"{driver}/msg/CustomPoint"]
    return store[f"{driver}/msg/CustomMsg"](
        header=header(kind, seconds, frame),
        timebase=12345678901234,
        point_num=len(points),
        lidar_id=1,
        rsvd=np.zeros(3, np.uint8),
        points=[
            point(offset_time=7 * i, x=float(x), y=float(y), z=float(z), reflectivity=250, tag=16, line=i % 6)
            for i, (x, y, z) in enumerate(points)
        ],
    )


def pose(kind: str, seconds: float, position: Any, quaternion: Any = (0, 0, 0, 1), name: str = ODOMETRY) -> Any:
    """A pose of base_link in odom, or a PoseStamped in map, at this time."""
    store = typestore(kind).types
    at = store["geometry_msgs/msg/Point"](*map(float, position))
    turned = store["geometry_msgs/msg/Quaternion"](*map(float, quaternion))
    plain = store["geometry_msgs/msg/Pose"](position=at, orientation=turned)
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


def write_bag(
    path: Path, kind: str, messages: Iterable[tuple[str, str, float, Any]], *, compression: tuple[Any, ...] = ()
) -> Path:
    """Write messages (topic, type, seconds at which it was recorded, message) into a bag of a kind of `FILES`."""
    types = typestore(kind)
    storage = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    writer = Writer1(path) if kind == "ros1" else Writer2(path, version=9, storage_plugin=storage)
    if compression:
        writer.set_compression(*compression)
    with writer as bag:
        serialize = types.serialize_ros1 if kind == "ros1" else types.serialize_cdr
        connections = {}
        for topic, name, seconds, message in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, name, typestore=types)
            bag.write(connections[topic], round(seconds * 1e9), serialize(message, name))
    return path
