"""Publisher of scans and odometry on topics of ROS, for `live_dds` and `live_zenoh`."""

from collections.abc import Callable

import numpy as np

from sglpr_jax.live.ros import Transport
from sglpr_jax.live.ros_messages import CLOUD, TRANSFORMS, encode, transform_message, typestore


class RosPublisher:
    """Publishes clouds with 16 bytes a point, as common drivers do, and the odometry as a transform before each."""

    flags = ("--topic", "/points", "--odometry-topic", "/odometry")

    def __init__(self, connect: Callable[[], Transport]):
        """`connect` opens the connection with the first scan. Scans before the subscription finds it are lost."""
        self._connect = connect
        self._wire: Transport | None = None

    def put(self, points: np.ndarray, world_from_lidar: np.ndarray, stamp: float) -> None:
        """Publish a scan with its odometry at a time in seconds since 1970."""
        if self._wire is None:
            self._wire = self._connect()
            self._clouds = self._wire.advertise("/points", CLOUD, depth=1, latched=False)
            self._poses = self._wire.advertise("/odometry", TRANSFORMS, depth=100, latched=False)
        self._poses(encode(transform_message(world_from_lidar, time=stamp, frame="odom", child="lidar")))
        self._clouds(cloud(points, stamp))


def cloud(points: np.ndarray, stamp: float) -> bytes:
    """PointCloud2 with the fields x, y and z."""
    types = typestore().types
    padded = np.zeros((len(points), 4), np.float32)
    padded[:, :3] = points
    seconds, nanoseconds = divmod(round(stamp * 1e9), 10**9)
    time_of = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    field = types["sensor_msgs/msg/PointField"]
    found = types[CLOUD](
        header=types["std_msgs/msg/Header"](stamp=time_of, frame_id="lidar"),
        height=1,
        width=len(points),
        fields=[field(name=name, offset=4 * at, datatype=7, count=1) for at, name in enumerate("xyz")],
        is_bigendian=False,
        point_step=16,
        row_step=padded.nbytes,
        data=padded.view(np.uint8).reshape(-1),
        is_dense=True,
    )
    return encode(found)
