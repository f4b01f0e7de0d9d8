"""Loop edges to ROS 2 by zenoh: `zenoh` or `zenoh:ENDPOINT`."""

from sglpr_jax.live.report import Report
from sglpr_jax.live.ros_sink import RosSink
from sglpr_jax.live.ros_wire import domain_of
from sglpr_jax.live.sinks import SinkOptions
from sglpr_jax.live.zenoh_wire import ZenohWire


def open_sink(where: str, options: SinkOptions, report: Report) -> RosSink:
    """Connect and advertise. Raises ValueError if `where` is not an endpoint."""
    return RosSink(ZenohWire(where, domain_of("", source="zenoh"), report), options)
