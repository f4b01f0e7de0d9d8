"""Publisher of scans by DDS: `--source dds:DOMAIN` of `live`."""

from benchmarks.speed.live_ros import RosPublisher
from sglpr_jax.live.dds_wire import DdsWire
from sglpr_jax.live.report import Reports
from sglpr_jax.live.ros_wire import domain_of


def publisher(where: str) -> RosPublisher:
    """Publisher in a domain."""
    return RosPublisher(lambda: DdsWire(domain_of(where, source="dds"), Reports()))
