"""ROS 2 messages for the tests of the live node, encoded by rosbags' definitions of Humble."""

import dataclasses

import numpy as np

from sglpr_jax.live.ros_encoding import Received
from tests import bags

ODOMETRY = bags.ODOMETRY
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
    return encoded(bags.livox("ros2", seconds, points, driver=bags.LIVOX_DRIVERS[1], frame="lidar"))


def odometry(seconds: float, at, quaternion=(0, 0, 0, 1), *, child: str = "base") -> bytes:
    return encoded(dataclasses.replace(bags.pose("ros2", seconds, at, quaternion), child_frame_id=child))


def transforms(seconds: float, found) -> bytes:
    return encoded(bags.transforms("ros2", seconds, found))


def received(kind: str, cdr: bytes, *, publisher=1, at: float = 0.0) -> Received:
    return Received(kind, cdr, publisher, at)
