"""Scans from ROS 2 by zenoh: `zenoh` or `zenoh:ENDPOINT`, such as `zenoh:tcp/192.168.0.2:7447`."""

from sglpr_jax.live.report import Report
from sglpr_jax.live.ros_source import RosSource
from sglpr_jax.live.ros_wire import domain_of
from sglpr_jax.live.sources import SourceOptions
from sglpr_jax.live.zenoh_wire import ZenohWire


def open_source(where: str, options: SourceOptions, report: Report) -> RosSource:
    """Connect and subscribe. Raises ValueError if `where` is not an endpoint."""
    return RosSource(ZenohWire(where, domain_of("", source="zenoh"), report), options, report)
