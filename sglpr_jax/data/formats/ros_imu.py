"""Reads IMUs from ROS bags: sensor_msgs/Imu."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.ros_message import RosMessage
from sglpr_jax.data.formats.ros_tracks import Stamps, are_unit

IMU = "sensor_msgs/msg/Imu"
"""Message type of an IMU."""


class ImuMessages(NamedTuple):
    """Messages of an IMU."""

    stamps: Stamps
    frame: str
    """Frame of the IMU."""
    rates: Float[np.ndarray, "n 3"]
    """Angular velocities, in radians per second."""
    accelerations: Float[np.ndarray, "n 3"]
    """Accelerations, in m/s^2 or in multiples of gravity."""
    quaternions: Float[np.ndarray, "n 4"] | None
    """Orientations x, y, z, w, or None if the messages have none."""

    @classmethod
    def of(cls, messages: Iterable[tuple[int, RosMessage]]) -> "ImuMessages":
        """Decode messages with the times (ns) of their recorder."""
        recorded, own, numbers, frame = [], [], [], ""
        for time, message in messages:
            header = message.header()
            recorded.append(time)
            own.append(header.time)
            frame = frame or header.frame
            numbers.append(message.numbers("f8", 37))
        found = np.array(numbers, np.float64).reshape(-1, 37)
        turned, covariance, rates, accelerations = found[:, :4], found[:, 4], found[:, 13:16], found[:, 25:28]
        valid = len(found) and covariance[0] != -1 and are_unit(turned).all() and np.ptp(turned, axis=0).any()
        stamps = Stamps(np.array(recorded, np.int64), np.array(own, float))
        return cls(stamps, frame, rates, accelerations, turned if valid else None)
