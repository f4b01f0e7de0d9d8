"""Scans, poses and loops over DDS, in one domain on this computer. A peer uses cyclonedds' own types, as ROS 2 does."""

import itertools
import os
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from sglpr_jax.live.dds import DdsTransport
from sglpr_jax.live.options import LiveOptions
from sglpr_jax.live.ros_encoding import EDGE, TRANSFORMS, edge_message
from sglpr_jax.live.sources_and_sinks import open_sink, open_source
from tests.live.messages import decoded, transforms
from tests.live.test_ros_encoding import edge

LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>40</MaxAutoParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers></Discovery>"
    "</Domain></CycloneDDS>"
)
_DOMAINS = itertools.count(os.getpid(), 7)
SOON_S = 20.0
"""Time in which everything happens that these tests wait for, even on a busy machine."""
STILL = (0, 0, 0, 1)


@dataclass
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time
    frame_id: str


@dataclass
class PointField(IdlStruct, typename="sensor_msgs.msg.dds_.PointField_"):
    name: str
    offset: uint32
    datatype: uint8
    count: uint32


@dataclass
class PointCloud2(IdlStruct, typename="sensor_msgs.msg.dds_.PointCloud2_"):
    header: Header
    height: uint32
    width: uint32
    fields: sequence[PointField]
    is_bigendian: bool
    point_step: uint32
    row_step: uint32
    data: sequence[uint8]
    is_dense: bool


def cloud(seconds: float) -> PointCloud2:
    points = np.arange(60, dtype=np.float32).reshape(20, 3)
    fields = [PointField(name, 4 * at, 7, 1) for at, name in enumerate("xyz")]
    header = Header(Time(int(seconds), int(seconds % 1 * 1e9)), "lidar")
    return PointCloud2(header, 1, 20, fields, False, 12, points.nbytes, list(points.tobytes()), True)


@pytest.fixture
def domain(monkeypatch) -> str:
    """A DDS domain of this test, on this computer only. Publishers that were killed stay in theirs for seconds."""
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    return str(10 + next(_DOMAINS) % 90)


@pytest.fixture
def peer(domain, said):
    """Another participant of the domain."""
    transport = DdsTransport(int(domain), said)
    yield transport
    transport.close()


@pytest.fixture
def opened(domain, said):
    """Function that opens a source of the domain, which ends with the test."""
    sources = []

    def open_one(**options):
        sources.append(open_source(f"dds:{domain}", LiveOptions(**options), said))
        return sources[-1]

    yield open_one
    for source in sources:
        source.close()


def until(found: Callable[[], object]) -> None:
    """Wait until a function returns something true."""
    end = time.monotonic() + SOON_S
    while not found():
        assert time.monotonic() < end, "did not happen"
        time.sleep(0.02)


@pytest.mark.slow
def test_scans_and_poses_come_in_types_that_cyclonedds_encodes_itself(domain, peer, opened, said):
    frames = opened(odometry_topic="/tf", reliable=True).frames()
    peer.advertise("/tf_static", TRANSFORMS, depth=1, latched=True)(
        transforms(0, [("base", "lidar", (0, 0, 2), STILL)])
    )
    moves = peer.advertise("/tf", TRANSFORMS, depth=5, latched=False)
    participant = DomainParticipant(int(domain))
    qos = Qos(Policy.Reliability.Reliable(duration(milliseconds=100)), Policy.History.KeepLast(5))
    scans = DataWriter(participant, Topic(participant, "rt/points", PointCloud2), qos=qos)
    for step in range(400):
        seconds = 100 + 0.0625 * step
        moves(transforms(seconds, [("odom", "base", (2 * step / 16, 0, 0), STILL)]))
        scans.write(cloud(seconds))
        frame = next(frames)
        if frame is not None and frame.odometry is not None:
            break
        time.sleep(0.02)
    np.testing.assert_array_equal(frame.scan.points, np.arange(60, dtype=np.float32).reshape(20, 3))
    np.testing.assert_allclose(frame.odometry[:3, 3], [2 * (frame.time - 100), 0, 2], atol=1e-5)
    assert set(said.kinds) <= {"odometry", "missing"}, said


def test_edges_reach_a_subscriber_that_comes_later(domain, peer, said):
    sink = open_sink(f"dds:{domain}", LiveOptions(), said)
    sink.loop(edge())
    found = []
    peer.subscribe("/sglpr/loops", [EDGE], found.append, depth=10, reliable=True, latched=True)
    until(lambda: found)
    assert decoded(found[0].raw, EDGE).header.frame_id == "match/1000.250000000"
    assert EDGE in peer.published()["/sglpr/loops"]
    sink.close()
    until(lambda: "/sglpr/loops" not in peer.published())  # the end of a publisher is no message
    assert len(found) == 1 and not said


def test_two_types_are_published_on_one_topic(domain, peer, said):
    other, found = DdsTransport(int(domain), said), []
    other.subscribe("/both", [EDGE, TRANSFORMS], found.append, depth=10, reliable=True, latched=True)
    messages = {EDGE: edge_message(edge()), TRANSFORMS: transforms(0, [("odom", "base", (0, 0, 0), STILL)])}
    publish = {kind: peer.advertise("/both", kind, depth=1, latched=True) for kind in messages}
    for kind, raw in messages.items():
        publish[kind](raw)
    until(lambda: {message.kind for message in found} == set(messages))
    other.close()
    assert not said


def test_an_invalid_message_costs_no_other_one(domain, peer, said):
    other, found = DdsTransport(int(domain), said), []
    publish = other.advertise("/tf", TRANSFORMS, depth=3, latched=True)
    for seconds in range(3):
        publish(transforms(seconds, []))

    def receive(message) -> None:
        found.append(message)
        if len(found) == 1:
            raise ValueError("expected something else")

    peer.subscribe("/tf", [TRANSFORMS], receive, depth=3, reliable=True, latched=True)
    until(lambda: len(found) == 3)
    other.close()
    assert said.kinds == [f"message {TRANSFORMS}"]


def test_a_subscriber_with_another_qos_is_reported(domain, peer, said):
    sink = open_sink(f"dds:{domain}", LiveOptions(), said)
    peer.subscribe("/tf", [TRANSFORMS], lambda message: None, depth=1, reliable=True, latched=True)
    asked = "/tf: expected subscribers that accept the QoS reliable, volatile, found one that asks for more"
    until(lambda: any(text.startswith(f"{asked} (durability)") for _, text in said))
    sink.close()
