"""Scans from ROS 2 by DDS: `dds` or `dds:DOMAIN`."""

from sglpr_jax.live.dds_wire import DdsWire
from sglpr_jax.live.report import Report
from sglpr_jax.live.ros_source import RosSource
from sglpr_jax.live.ros_wire import domain_of
from sglpr_jax.live.sources import SourceOptions


def open_source(where: str, options: SourceOptions, report: Report) -> RosSource:
    """Join the domain and subscribe. Raises ValueError if `where` is not a domain."""
    return RosSource(DdsWire(domain_of(where, source="dds"), report), options, report)
