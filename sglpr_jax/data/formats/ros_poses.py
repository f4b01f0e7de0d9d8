"""Poses among the messages of a bag: nav_msgs/Odometry and geometry_msgs/PoseStamped."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.ros_message import RosMessage


class StampedPosition(NamedTuple):
    """Where something was."""

    time: float
    """Seconds, of the message's header."""
    position: Float[np.ndarray, " 3"]
    frames: str
    """What was where: "base_link in odom"."""


def _odometry(message: RosMessage) -> StampedPosition:
    header, child = message.header(), message.text()
    return StampedPosition(header.time, message.numbers("f8", 3), f"{child or 'a body'} in {header.frame or 'a frame'}")


def _pose_stamped(message: RosMessage) -> StampedPosition:
    header = message.header()
    return StampedPosition(header.time, message.numbers("f8", 3), f"in {header.frame or 'a frame'}")


POSES: dict[str, Callable[[RosMessage], StampedPosition]] = {
    "nav_msgs/msg/Odometry": _odometry,
    "geometry_msgs/msg/PoseStamped": _pose_stamped,
}
"""Types of messages that tell where the vehicle is."""
