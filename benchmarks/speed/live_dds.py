"""Publisher of scans by DDS: `--source dds:DOMAIN` of `live`."""

from benchmarks.speed.live_ros import RosPublisher
from sglpr_jax.live.dds import DdsTransport
from sglpr_jax.live.messages import Reports
from sglpr_jax.live.ros import domain_of


def publisher(where: str) -> RosPublisher:
    """Publisher in a domain."""
    return RosPublisher(lambda: DdsTransport(domain_of(where, source="dds"), Reports()))
