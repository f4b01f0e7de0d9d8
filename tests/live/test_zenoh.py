"""Scans, poses and loops over zenoh. A peer uses the keys, attachments and tokens of rmw_zenoh."""

import json
import socket
import struct
import time

import numpy as np
import pytest
import zenoh

from sglpr_jax.live.options import LiveOptions
from sglpr_jax.live.ros_encoding import CLOUD, EDGE, TRANSFORMS
from sglpr_jax.live.sources_and_sinks import open_sink, open_source
from sglpr_jax.live.zenoh import ZenohTransport
from tests.live.messages import cloud, decoded, transforms
from tests.live.test_dds import STILL, until
from tests.live.test_ros_encoding import edge

SCANS = "sensor_msgs::msg::dds_::PointCloud2_/RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
TF = "tf2_msgs::msg::dds_::TFMessage_/RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"


@pytest.fixture
def endpoint(monkeypatch) -> str:
    """A zenoh endpoint at a free port."""
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{found.getsockname()[1]}"


@pytest.mark.slow
def test_scans_and_poses_come(endpoint, said):
    config = zenoh.Config()
    for key, value in (("listen/endpoints", [endpoint]), ("scouting/multicast/enabled", False)):
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        topics = list(enumerate((("points", SCANS), ("tf", TF))))
        node = f"@ros2_lv/0/{session.zid()}/0"
        keys = [f"{node}/{number}/MP/%/%/talker/%{name}/{kind}/::,5:,:,:,," for number, (name, kind) in topics]
        tokens = [session.liveliness().declare_token(key) for key in keys]
        source = open_source(f"zenoh:{endpoint}", LiveOptions(odometry_topic="tf"), said)
        frames = source.frames()
        for step in range(400):
            seconds = 100 + 0.0625 * step
            about = struct.pack("<qqB16s", step, time.time_ns(), 16, b"talker")
            moved = transforms(seconds, [("odom", "lidar", (seconds, 0, 0), STILL)])
            session.put(f"0/tf/{TF}", moved, attachment=about)
            session.put(f"0/points/{SCANS}", cloud(seconds), attachment=about)
            frame = next(frames)
            if frame is not None and frame.odometry is not None:
                break
        until(lambda: source._transport.published() == {"/points": {CLOUD}, "/tf": {TRANSFORMS}})
        source.close()
        del tokens
    np.testing.assert_allclose(frame.odometry[:3, 3], [frame.time, 0, 0], atol=1e-5)
    assert set(said.kinds) <= {"odometry", "missing"}, said


def test_edges_reach_a_subscriber_that_comes_later(endpoint, said, monkeypatch, tmp_path):
    listening = tmp_path / "listening.json5"
    listening.write_text(f'{{listen: {{endpoints: ["{endpoint}"]}}, scouting: {{multicast: {{enabled: false}}}}}}')
    monkeypatch.setenv("ZENOH_SESSION_CONFIG_URI", str(listening))
    sink = open_sink("zenoh", LiveOptions(), said)
    sink.loop(edge())
    other, found = ZenohTransport(endpoint, 0, said), []
    other.subscribe("/sglpr/loops", [EDGE], found.append, depth=10, reliable=True, latched=True)
    until(lambda: found)
    assert decoded(found[0].raw, EDGE).header.frame_id == "match/1000.250000000"
    assert EDGE in other.published()["/sglpr/loops"]
    other.close()
    sink.close()
    assert not said


def test_an_endpoint_that_is_none_is_one_clear_error(said):
    with pytest.raises(ValueError, match="zenoh: expected a valid endpoint or configuration, found nonsense"):
        open_source("zenoh:nonsense", LiveOptions(), said)
