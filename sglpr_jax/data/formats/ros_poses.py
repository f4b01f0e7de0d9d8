"""Reads poses from ROS messages: nav_msgs/Odometry, geometry_msgs/PoseStamped and tf."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.ros_message import RosMessage


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


def _odometry(message: RosMessage) -> StampedPose:
    header, child = message.header(), message.text()
    return StampedPose(header.time, child, header.frame, message.numbers("f8", 7))


def _pose_stamped(message: RosMessage) -> StampedPose:
    header = message.header()
    return StampedPose(header.time, "", header.frame, message.numbers("f8", 7))


def read_transforms(message: RosMessage) -> Iterator[StampedPose]:
    """Read the transforms of a tf message. Each is the pose of its child frame in the frame of its header."""
    for _ in range(int(message.numbers("u4")[0])):
        yield _odometry(message)  # header, child, and the same seven numbers


POSES: dict[str, Callable[[RosMessage], StampedPose]] = {
    "nav_msgs/msg/Odometry": _odometry,
    "geometry_msgs/msg/PoseStamped": _pose_stamped,
}
"""Message types with poses of the vehicle, and their readers."""
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""Message types of tf."""
