"""ROS 2 messages for the tests of the live node, encoded by rosbags' definitions of Humble."""

import numpy as np

from sglpr_jax.live.ros_messages import Received
from tests import bags

ODOMETRY = "nav_msgs/msg/Odometry"
LIVOX = "livox_ros_driver2/msg/CustomMsg"
POINTS = np.random.default_rng(5).normal(scale=9, size=(64, 3)).astype(np.float32)


def encoded(message) -> bytes:
    """CDR of a message of `bags.typestore`."""
    return bytes(bags.typestore("ros2").serialize_cdr(message, message.__msgtype__))


def decoded(cdr: bytes, kind: str):
    return bags.typestore("ros2").deserialize_cdr(cdr, kind)


def cloud(seconds: float = 12.5, points: np.ndarray = POINTS) -> bytes:
    return encoded(bags.cloud("ros2", seconds, points, ring=np.arange(len(points), dtype="<u4")))


def livox(seconds: float = 12.5, points: np.ndarray = POINTS) -> bytes:
    store = bags.typestore("ros2").types
    point = store["livox_ros_driver2/msg/CustomPoint"]
    rows = [point(i, *map(float, xyz), 9, 0, i % 4) for i, xyz in enumerate(points)]
    head = bags.header("ros2", seconds, "lidar")
    return encoded(store[LIVOX](head, 7, len(rows), 1, np.zeros(3, np.uint8), rows))


def odometry(seconds: float, at, turned=(0.0, 0.0, 0.0, 1.0), *, child: str = "base") -> bytes:
    store = bags.typestore("ros2").types
    pose = store["geometry_msgs/msg/Pose"](
        store["geometry_msgs/msg/Point"](*map(float, at)), store["geometry_msgs/msg/Quaternion"](*map(float, turned))
    )
    zero = store["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    head = bags.header("ros2", seconds, "odom")
    still = store["geometry_msgs/msg/TwistWithCovariance"](store["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36))
    posed = store["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36))
    return encoded(store[ODOMETRY](head, child, posed, still))


def transforms(seconds: float, found) -> bytes:
    return encoded(bags.transforms("ros2", seconds, found))


def received(kind: str, cdr: bytes, *, publisher=1, at: float = 0.0) -> Received:
    return Received(kind, cdr, publisher, at)
