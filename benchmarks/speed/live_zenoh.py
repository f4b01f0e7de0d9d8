"""Publisher of scans by zenoh: `--source zenoh:ENDPOINT` of `live`, such as `zenoh:tcp/127.0.0.1:7450`."""

import json
import os
import tempfile

from benchmarks.speed.live_ros import RosPublisher
from sglpr_jax.live.messages import Reports
from sglpr_jax.live.ros import domain_of
from sglpr_jax.live.zenoh import ZenohTransport


def publisher(where: str) -> RosPublisher:
    """Publisher that listens at an endpoint."""
    return RosPublisher(lambda: _listening(where))


def _listening(endpoint: str) -> ZenohTransport:
    config = {"listen": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
    with tempfile.NamedTemporaryFile("w", suffix=".json5") as file:
        json.dump(config, file)
        file.flush()
        os.environ["ZENOH_SESSION_CONFIG_URI"] = file.name
        return ZenohTransport("", domain_of("", source="zenoh"), Reports())
