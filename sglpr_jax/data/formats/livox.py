"""Reads Livox messages in ROS bags: CustomMsg of livox_ros_driver and livox_ros_driver2.

The header is followed by uint64 timebase, uint32 point_num, uint8 lidar_id, uint8[3] rsvd, and the points.
"""

import numpy as np

from sglpr_jax.data.formats.bin_records import Records
from sglpr_jax.data.formats.ros_message import RosMessage
from sglpr_jax.data.point_times import TimeField

CUSTOM_MSG = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")
POINT = {
    "offset_time": "u4",
    "x": "f4",
    "y": "f4",
    "z": "f4",
    "reflectivity": "u1",
    "tag": "u1",
    "line": "u1",
}
"""Fields of a point, and their numpy types."""


def read_custom_msg(message: RosMessage) -> Records:
    """Return the points (n, 3) in the axes of the message, their line numbers and their times.

    Raises:
      ValueError: If the message is truncated or has no points.
    """
    message.header()
    message.numbers("u8")
    message.numbers("u4")
    message.numbers("u1", 4)
    points = message.records(POINT)
    if not len(points):
        raise ValueError("expected at least one point, found none")
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float32)
    return Records(xyz, points["line"].astype(np.int32), TimeField("offset_time", points["offset_time"].copy()))
