"""Publisher of scans by zenoh: `--source zenoh:ENDPOINT` of `live`, such as `zenoh:tcp/127.0.0.1:7450`."""

import json
import os
import tempfile

from benchmarks.speed.live_ros import RosPublisher
from sglpr_jax.live.report import Reports
from sglpr_jax.live.ros_wire import domain_of
from sglpr_jax.live.zenoh_wire import ZenohWire


def publisher(where: str) -> RosPublisher:
    """Publisher that listens at an endpoint."""
    return RosPublisher(lambda: _listening(where))


def _listening(endpoint: str) -> ZenohWire:
    config = {"listen": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
    with tempfile.NamedTemporaryFile("w", suffix=".json5") as file:
        json.dump(config, file)
        file.flush()
        os.environ["ZENOH_SESSION_CONFIG_URI"] = file.name
        return ZenohWire("", domain_of("", source="zenoh"), Reports())
