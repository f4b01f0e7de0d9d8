"""Scans from another process, and loops to subscribers, over DDS and zenoh."""

import contextlib
import itertools
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.live.dds_wire import DdsWire
from sglpr_jax.live.ros_messages import CLOUD, EDGE, TRANSFORMS
from sglpr_jax.live.ros_wire import Received
from sglpr_jax.live.sinks import SinkOptions, open_sink
from sglpr_jax.live.sources import SourceOptions, open_source
from sglpr_jax.live.zenoh_wire import ZenohWire
from tests.live.messages import LIVOX, Said, cloud, decoded, transforms
from tests.live.test_ros_messages import edge

HERE = Path(__file__).parent
LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>40</MaxAutoParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers></Discovery>"
    "</Domain></CycloneDDS>"
)
_DOMAINS = itertools.count(os.getpid(), 7)
SOON_S = 20.0
"""Time in which everything happens that these tests wait for, even on a busy machine."""
LATE = {"odometry", "missing", "silent"}
"""Reports that are right on a busy machine, where a process needs seconds to begin."""
STILL = (0, 0, 0, 1)


@pytest.fixture
def said() -> Said:
    return Said()


@pytest.fixture
def domain(monkeypatch) -> str:
    """A DDS domain of this test, on this computer only. Publishers that were killed stay in theirs for seconds."""
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    return str(10 + next(_DOMAINS) % 90)


@pytest.fixture
def endpoint(monkeypatch) -> str:
    """A zenoh endpoint at a free port."""
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{found.getsockname()[1]}"


@contextlib.contextmanager
def talking(name: str, *arguments: str) -> Iterator[None]:
    """Run a program of this folder until the end of the block."""
    with subprocess.Popen([sys.executable, str(HERE / name), *arguments]) as talker:
        try:
            yield
        finally:
            talker.kill()


def until(found: Callable[[], object]) -> None:
    """Wait until a function returns something true."""
    end = time.monotonic() + SOON_S
    while not found():
        assert time.monotonic() < end, "did not happen"
        time.sleep(0.02)


@contextlib.contextmanager
def opened(text: str, said: Said, **options) -> Iterator:
    source = open_source(text, SourceOptions(**options), said)
    try:
        yield source
    finally:
        source.close()


def first(source, fits=lambda frame: True):
    end = time.monotonic() + SOON_S
    for frame in source.frames():
        if frame is not None and fits(frame):
            return frame
        assert time.monotonic() < end, "no scan came"


@pytest.mark.slow
@pytest.mark.parametrize("reliable", [False, True])
def test_scans_and_poses_come_over_dds(domain, said, reliable):
    """From types that cyclonedds encodes itself."""
    options = {"odometry_topic": "/tf", "reliable": reliable}
    talker = talking("dds_talker.py", domain, "reliable", "PointCloud2")
    with opened(f"dds:{domain}", said, **options) as source, talker:
        frame = first(source, lambda frame: frame.odometry is not None)
    np.testing.assert_array_equal(frame.record.points, np.arange(60, dtype=np.float32).reshape(20, 3))
    np.testing.assert_allclose(frame.odometry[:3, 3], [2 * (frame.time - 100), 0, 2], atol=1e-5)
    assert set(said) <= LATE, said.lines


@pytest.mark.slow
def test_a_publisher_with_another_qos_is_reported(domain, said):
    talker = talking("dds_talker.py", domain, "best", "PointCloud2")
    with opened(f"dds:{domain}", said, reliable=True) as source, talker:
        frames = source.frames()
        until(lambda: next(frames) or said)
    assert said.lines == [
        "/points: expected a publisher with the QoS reliable, volatile, found one without (reliability); they do not "
        "exchange messages"
    ]


@pytest.mark.slow
def test_a_topic_with_another_type_is_reported(domain, said):
    with opened(f"dds:{domain}", said) as source, talking("dds_talker.py", domain, "best", "LaserScan"):
        source._missing_s = 0.5
        frames = source.frames()
        until(lambda: next(frames) or "type" in said)
    assert said["type"] == [f"/points: expected {CLOUD} or {LIVOX}, found sensor_msgs/msg/LaserScan; waiting"]


@pytest.mark.slow
def test_a_topic_that_is_missing_is_reported_with_those_that_exist(domain, said):
    talker = talking("dds_talker.py", domain, "best", "PointCloud2")
    with opened(f"dds:{domain}", said, topic="/rslidar") as source, talker:
        source._missing_s = 0.5
        frames = source.frames()
        exist = f"existing topics: /points ({CLOUD}), /tf ({TRANSFORMS}), /tf_static ({TRANSFORMS}); waiting"
        until(lambda: next(frames) or any(exist in text for text in said.lines))
    wanted = f"/rslidar: expected {CLOUD} or {LIVOX}, found no such topic; {exist}"
    assert wanted in said["missing"]


def test_edges_reach_a_subscriber_that_comes_later_over_dds(domain, said):
    sink = open_sink(f"dds:{domain}", SinkOptions(), said)
    sink.loop(edge())
    other, found = DdsWire(int(domain), said), []
    other.subscribe("/sglpr/loops", [EDGE], found.append, depth=10, reliable=True, latched=True)
    until(lambda: found)
    assert received_frame(found[0]) == "match/1000.250000000"
    assert EDGE in other.published()["/sglpr/loops"]
    sink.close()
    until(lambda: "/sglpr/loops" not in other.published())  # the end of a publisher is no message
    other.close()
    assert len(found) == 1 and not said


def test_a_connection_that_only_publishes_does_not_use_a_core(domain, said):
    wire = DdsWire(int(domain), said)
    waits = []
    wire._waiting.wait = lambda timeout: waits.append(timeout) or 0  # pyright: ignore
    wire.advertise("/points", CLOUD, depth=1, latched=False)
    time.sleep(0.3)
    wire.close()
    assert waits == []  # cyclonedds returns from it at once, so that the thread would call it all the time


def test_a_subscriber_with_another_qos_is_reported(domain, said):
    sink = open_sink(f"dds:{domain}", SinkOptions(), said)
    other = DdsWire(int(domain), Said())
    other.subscribe("/tf", [TRANSFORMS], lambda message: None, depth=1, reliable=True, latched=True)
    until(lambda: said)
    assert said.lines == [
        "/tf: expected subscribers that accept the QoS reliable, volatile, found one that asks for more (durability); "
        "they do not exchange messages"
    ]
    other.close()
    sink.close()


@pytest.mark.slow
def test_scans_and_poses_come_over_zenoh(endpoint, said, tmp_path):
    steps = [100 + 0.05 * step for step in range(200)]
    messages = {
        "clouds": [cloud(seconds) for seconds in steps],
        "tf": [transforms(seconds, [("odom", "lidar", (seconds, 0, 0), STILL)]) for seconds in steps],
    }
    for name, found in messages.items():
        (tmp_path / name).write_text("\n".join(message.hex() for message in found))
    files = (str(tmp_path / "clouds"), str(tmp_path / "tf"))
    with talking("zenoh_talker.py", endpoint, *files), opened(f"zenoh:{endpoint}", said, odometry_topic="tf") as source:
        frame = first(source, lambda frame: frame.odometry is not None)
        until(lambda: source._wire.published() == {"/points": {CLOUD}, "/tf": {TRANSFORMS}})
    np.testing.assert_allclose(frame.odometry[:3, 3], [frame.time, 0, 0], atol=1e-5)
    assert set(said) <= LATE, said.lines


def test_edges_reach_a_subscriber_that_comes_later_over_zenoh(endpoint, said, monkeypatch, tmp_path):
    listening = tmp_path / "listening.json5"
    listening.write_text(f'{{listen: {{endpoints: ["{endpoint}"]}}, scouting: {{multicast: {{enabled: false}}}}}}')
    monkeypatch.setenv("ZENOH_SESSION_CONFIG_URI", str(listening))
    sink = open_sink("zenoh", SinkOptions(), said)
    sink.loop(edge())
    other, found = ZenohWire(endpoint, 0, said), []
    other.subscribe("/sglpr/loops", [EDGE], found.append, depth=10, reliable=True, latched=True)
    until(lambda: found)
    assert received_frame(found[0]) == "match/1000.250000000"
    assert EDGE in other.published()["/sglpr/loops"]
    other.close()
    sink.close()
    assert not said


def test_a_wrong_configuration_is_one_clear_error(domain, monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", "<nonsense")
    with pytest.raises(ValueError, match=f"dds:{domain}: expected a network .* CYCLONEDDS_URI, found <nonsense"):
        open_source(f"dds:{domain}", SourceOptions(), Said())


def test_an_endpoint_that_is_none_is_one_clear_error(said):
    with pytest.raises(ValueError, match="zenoh: expected a valid endpoint or configuration, found nonsense"):
        open_source("zenoh:nonsense", SourceOptions(), said)


def received_frame(message: Received) -> str:
    return decoded(message.raw, message.kind).header.frame_id
