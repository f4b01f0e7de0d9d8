"""Poses among the messages of a bag: nav_msgs/Odometry, geometry_msgs/PoseStamped, and those of tf."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.ros_message import RosMessage


class StampedPose(NamedTuple):
    """Where something was, and how it was turned."""

    time: float
    """Seconds, of the message's header."""
    child: str
    """What was there: "base_link"; empty where the message does not say."""
    frame: str
    """In which frame: "odom"."""
    numbers: Float[np.ndarray, " 7"]
    """x, y, z in metres, and a quaternion x, y, z, w."""


def _odometry(message: RosMessage) -> StampedPose:
    header, child = message.header(), message.text()
    return StampedPose(header.time, child, header.frame, message.numbers("f8", 7))


def _pose_stamped(message: RosMessage) -> StampedPose:
    header = message.header()
    return StampedPose(header.time, "", header.frame, message.numbers("f8", 7))


def read_transforms(message: RosMessage) -> Iterator[StampedPose]:
    """The transforms of a message of tf: each is the pose of its child frame in its header's."""
    for _ in range(int(message.numbers("u4")[0])):
        yield _odometry(message)  # header, child, and the same seven numbers


POSES: dict[str, Callable[[RosMessage], StampedPose]] = {
    "nav_msgs/msg/Odometry": _odometry,
    "geometry_msgs/msg/PoseStamped": _pose_stamped,
}
"""Types of messages that tell where the vehicle is."""
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""Types of messages of tf."""
