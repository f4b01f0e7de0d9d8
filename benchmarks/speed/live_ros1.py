"""Publisher of scans by rospy: `--source ros1:MASTER` of `live`, such as `ros1:http://localhost:11311`."""

from benchmarks.speed.live_ros import RosPublisher
from sglpr_jax.live.report import Reports
from sglpr_jax.live.ros1_wire import Ros1Wire


def publisher(where: str) -> RosPublisher:
    """Publisher at a running roscore."""
    return RosPublisher(lambda: Ros1Wire(where, Reports()))
