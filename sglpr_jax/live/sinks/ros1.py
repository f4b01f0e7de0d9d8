"""Loop edges to ROS 1: `ros1` or `ros1:MASTER`, such as `ros1:http://192.168.0.2:11311`."""

from sglpr_jax.live.report import Report
from sglpr_jax.live.ros1_wire import Ros1Wire
from sglpr_jax.live.ros_sink import RosSink
from sglpr_jax.live.sinks import SinkOptions


def open_sink(where: str, options: SinkOptions, report: Report) -> RosSink:
    """Register a node and advertise. Raises ValueError if no roscore answers, and ImportError without rospy."""
    return RosSink(Ros1Wire(where, report), options)
