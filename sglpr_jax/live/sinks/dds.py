"""Loop edges to ROS 2 by DDS: `dds` or `dds:DOMAIN`."""

from sglpr_jax.live.dds_wire import DdsWire
from sglpr_jax.live.report import Report
from sglpr_jax.live.ros_sink import RosSink
from sglpr_jax.live.ros_wire import domain_of
from sglpr_jax.live.sinks import SinkOptions


def open_sink(where: str, options: SinkOptions, report: Report) -> RosSink:
    """Join the domain and advertise. Raises ValueError if `where` is not a domain."""
    return RosSink(DdsWire(domain_of(where, source="dds"), report), options)
