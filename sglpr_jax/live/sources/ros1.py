"""Scans from ROS 1: `ros1` or `ros1:MASTER`, such as `ros1:http://192.168.0.2:11311`."""

from sglpr_jax.live.report import Report
from sglpr_jax.live.ros1_wire import Ros1Wire
from sglpr_jax.live.ros_source import RosSource
from sglpr_jax.live.sources import SourceOptions


def open_source(where: str, options: SourceOptions, report: Report) -> RosSource:
    """Register a node and subscribe. Raises ValueError if no roscore answers, and ImportError without rospy."""
    return RosSource(Ros1Wire(where, report), options, report)
