"""Points of Livox's own message in ROS bags, CustomMsg of livox_ros_driver and livox_ros_driver2.

After the header: uint64 timebase, uint32 point_num, uint8 lidar_id, uint8[3] rsvd, and the points.
"""

import numpy as np

from sglpr_jax.data.formats.bin_records import Records
from sglpr_jax.data.formats.ros_message import RosMessage

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
"""The fields of a point, and numpy's names of their types."""


def read_custom_msg(message: RosMessage) -> Records:
    """Return points (n, 3), as they are in the message, and their lines. Raises ValueError for a message cut off."""
    message.header()
    message.numbers("u8")
    message.numbers("u4")
    message.numbers("u1", 4)
    points = message.records(POINT)
    if not len(points):
        raise ValueError("expected at least one point, found none")
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float32)
    return Records(xyz, points["line"].astype(np.int32))
