"""Source and sink of ROS 2 topics, with a connection in memory."""

import itertools
import time as clock

import numpy as np
import pytest

from sglpr_jax.live.data_types import FrameStatus, LoopEdge
from sglpr_jax.live.options import LiveOptions
from sglpr_jax.live.ros_encoding import CLOUD, DELETE, MARKERS, TRANSFORMS
from sglpr_jax.live.ros_topics import TAKEOVER_S, RosSink, RosSource, domain_of
from tests.live.messages import LIVOX, ODOMETRY, POINTS, cloud, decoded, odometry, received


class Memory:
    """A `Transport` without a network."""

    def __init__(self):
        self.topics: dict[str, set[str]] = {}
        self.receive, self.sent, self.closed = {}, [], False

    def subscribe(self, topic, kinds, receive, **_):
        self.receive[topic] = receive

    def advertise(self, topic, kind, **_):
        return lambda cdr: self.sent.append((topic, kind, decoded(cdr, kind)))

    def published(self):
        return self.topics

    def close(self):
        self.closed = True


@pytest.fixture
def transport() -> Memory:
    return Memory()


@pytest.fixture
def source(transport, said, monkeypatch) -> RosSource:
    monkeypatch.setattr("sglpr_jax.live.ros_topics.MISSING_S", 0.0)
    return RosSource(transport, LiveOptions(topic="points", odometry_topic="/odom"), said)


def test_a_scan_has_points_time_and_pose(transport, source, said):
    for seconds in (12.4, 12.6):
        message = odometry(seconds, (seconds, 0, 0), child="lidar")
        transport.receive["/odom"](received(ODOMETRY, message, at=clock.monotonic()))
    transport.receive["/points"](received(CLOUD, cloud(12.5), at=3.0))
    frame = next(source.frames())
    np.testing.assert_array_equal(frame.scan.points, POINTS)
    assert (frame.time, frame.received, frame.scan.name) == (12.5, 3.0, "")
    np.testing.assert_allclose(frame.odometry[:3, 3], [12.5, 0, 0])
    assert not said


def test_an_invalid_cloud_is_reported_and_the_next_one_taken(transport, source, said):
    transport.receive["/points"](received(CLOUD, cloud()[:50]))
    frames = source.frames()
    assert next(frames) is None
    assert said.of("cloud")[0].startswith("/points: expected a cloud with points, found an invalid one (")
    transport.receive["/points"](received(CLOUD, cloud()))
    assert next(frames) is not None


def test_whatever_a_message_holds_the_source_lives_on(transport, source, said, monkeypatch):
    def fail(*_: object, **__: object) -> None:
        raise KeyError("a fault that nobody thought of")

    monkeypatch.setattr(source._odometry, "pose", fail)
    frames = source.frames()
    for _ in range(2):
        transport.receive["/points"](received(CLOUD, cloud()))
        assert next(frames) is None
    assert "/points: a scan is left out: " in said.of("message")[0]


def test_scans_of_a_second_publisher_are_left_out_until_the_first_is_silent(transport, source, said):
    frames = source.frames()
    for publisher, at, taken in (
        ("a", 1.0, True),
        ("b", 1.1, False),
        ("a", 1.2, True),
        ("b", 1.3 + TAKEOVER_S, True),
    ):
        transport.receive["/points"](received(CLOUD, cloud(at), publisher=publisher, at=at))
        assert (next(frames) is not None) == taken
    assert said.of("publishers") == ["/points: expected one publisher, found several; the scans of the first are used"]


def test_an_invalid_scan_costs_no_other_one(transport, source, said):
    """Neither one that waits, nor those of the publisher that sends valid ones."""
    transport.receive["/points"](received(LIVOX, b"", publisher="b", at=0.9))
    transport.receive["/points"](received(CLOUD, cloud(), publisher="a", at=1.0))
    transport.receive["/points"](received(CLOUD, cloud()[:50], publisher="a", at=1.1))
    assert next(source.frames()).received == 1.0
    assert (said.kinds.count("cloud"), source.dropped) == (2, 0)


def test_a_single_scan_of_an_earlier_time_has_no_pose(transport, source, said):
    for seconds in (12.0, 12.5, 13.0):
        message = odometry(seconds, (seconds, 0, 0), child="lidar")
        transport.receive["/odom"](received(ODOMETRY, message, at=clock.monotonic()))
    frames, found = source.frames(), []
    for seconds in (12.8, 12.2, 12.9, 12.3, 12.4, 12.5):  # the last ones by another clock
        transport.receive["/points"](received(CLOUD, cloud(seconds)))
        found.append(next(frames).odometry is not None)
    assert found == [True, False, True, False, True, True]
    assert said.kinds == ["order", "order"]


@pytest.mark.parametrize(
    "topics, kind, found",
    [
        ({}, "missing", "found no such topic; existing topics: none; waiting"),
        ({"/points": {"std_msgs/msg/String"}}, "type", "found std_msgs/msg/String; waiting"),
        ({"/points": {CLOUD}}, "silent", "found a publisher but no message for 0 s; waiting"),
    ],
)
def test_a_topic_that_does_not_come_is_reported(transport, source, said, topics, kind, found):
    transport.topics = topics
    assert list(itertools.islice(source.frames(), 1)) == [None]
    assert said.of(kind)[0].startswith(f"/points: expected {CLOUD} or {LIVOX}, ") and found in said.of(kind)[0]


def moved(x: float, y: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, 3] = x, y
    return pose


def edge(query: int, match: int, world_from_query, world_from_match, match_from_query) -> LoopEdge:
    return LoopEdge(
        query, match, 50.0, 10.0, match_from_query, np.eye(6), 0.9, world_from_query, world_from_match, 0.01
    )


def status(time: float = 50.0, map_from_world: np.ndarray | None = None) -> FrameStatus:
    return FrameStatus(4, time, 0.01, 0.02, 0, 5, 100, map_from_world)


def sent(transport: Memory, kind: str) -> list:
    return [message for _, one, message in transport.sent if one == kind]


def test_an_edge_is_published_and_drawn(transport):
    sink = RosSink(transport, LiveOptions())
    sink.loop(edge(80, 2, moved(9, 1), moved(0), moved(0.5)))
    assert {topic for topic, *_ in transport.sent} == {"/sglpr/loops", "/sglpr/loop_markers"}
    ends = sent(transport, MARKERS)[-1].markers[0].points
    assert [(one.x, one.y) for one in ends] == [(0, 0), (9, 1)]


def test_lines_of_an_earlier_odometry_frame_are_deleted(transport):
    sink = RosSink(transport, LiveOptions())
    sink.loop(edge(80, 2, moved(9), moved(0), moved(0.5)))
    sink.loop(edge(90, 3, moved(1), None, moved(0.5))._replace(odometry_frame=1))
    sink.loop(edge(99, 91, moved(2), moved(1), moved(0.5))._replace(odometry_frame=1))
    drawn = [message.markers[0] for message in sent(transport, MARKERS)]
    assert [(one.action, len(one.points)) for one in drawn] == [(0, 2), (DELETE, 0), (0, 2)]


def test_the_correction_of_the_odometry_is_published(transport):
    sink = RosSink(transport, LiveOptions())
    sink.frame(status())
    assert transport.sent == []
    sink.frame(status(map_from_world=moved(-8.5, -1)))
    found = sent(transport, TRANSFORMS)[-1].transforms[0]
    assert (found.header.frame_id, found.child_frame_id, found.header.stamp.sec) == ("map", "odom", 50)
    assert (found.transform.translation.x, found.transform.translation.y) == (-8.5, -1)
    sink.frame(status(float("nan"), np.eye(4)))  # a scan without a time: now
    assert sent(transport, TRANSFORMS)[-1].transforms[0].header.stamp.sec > 1e9


def test_the_domain_comes_from_the_text_or_the_environment(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    assert (domain_of("3", source="dds"), domain_of("", source="dds")) == (3, 7)
    monkeypatch.delenv("ROS_DOMAIN_ID")
    assert domain_of("", source="dds") == 0
    for wrong in ("x", "-1", "233"):
        with pytest.raises(ValueError, match=f"dds: expected a ROS 2 domain from 0 to 232, found {wrong}"):
            domain_of(wrong, source="dds")
