"""The live node lives on, whatever a message of ROS holds, and takes the whole messages after it."""

import contextlib
import itertools
import time
import warnings

import pytest
from clouds import street
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import sglpr_jax
from sglpr_jax.live import ros_topics
from sglpr_jax.live.live_map import LiveMap
from sglpr_jax.live.node import Node
from sglpr_jax.live.options import LiveOptions
from sglpr_jax.live.ros_encoding import CLOUD, TRANSFORMS
from sglpr_jax.live.ros_topics import RosSource
from sglpr_jax.loops.detector import LoopDetector
from tests import bags
from tests.live.messages import LIVOX, ODOMETRY, cloud, encoded, livox, odometry, received, transforms
from tests.live.test_ros_topics import Memory

from .damage import damaged

BEGIN = 1000.0
"""Time of the first message, in seconds."""
STREET = street(0, height_m=1.7).astype("f4")
WHOLE = {
    "/points": {CLOUD: lambda t: cloud(t, STREET), LIVOX: lambda t: livox(t, STREET)},
    "/odom": {
        ODOMETRY: lambda t: odometry(t, (t - BEGIN, 0, 0), child="lidar"),
        bags.POSE: lambda t: encoded(bags.pose("ros2", t, (t - BEGIN, 0, 0), name=bags.POSE)),
        TRANSFORMS: lambda t: transforms(t, [("odom", "lidar", (t - BEGIN, 0, 0), (0, 0, 0, 1))]),
    },
    "/tf_static": {TRANSFORMS: lambda t: transforms(t, [("base", "lidar", (0, 0, 1), (0, 0, 0, 1))])},
}
"""Whole messages of a time, by topic and type."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A function that sends a message to a node, and then a whole scan with its odometry. Returns the scans that the
    node has added or left out."""

    def report(kind: str, text: str) -> None:
        pass

    transport = Memory()
    source = RosSource(transport, LiveOptions(topic="/points", odometry_topic="/odom"), report)
    detector, folder = LoopDetector(sglpr_jax.load("sglpr-small")), tmp_path_factory.mktemp("map")
    live = LiveMap(detector, folder, report=report, expects_odometry=True)
    live.restore()
    node, seconds = Node(live, [], report=report, say=lambda _: None), itertools.count()

    def send(topic: str, kind: str, raw: bytes) -> int:
        t = BEGIN + next(seconds)
        with contextlib.suppress(Exception):  # as every connection does, with a report
            transport.receive[topic](received(kind, raw, at=time.monotonic()))
        _take(node, source)
        for at in (t - 0.05, t + 0.05):
            transport.receive["/odom"](received(ODOMETRY, WHOLE["/odom"][ODOMETRY](at), at=time.monotonic()))
        transport.receive["/points"](received(CLOUD, WHOLE["/points"][CLOUD](t), at=time.monotonic()))
        _take(node, source)
        return node.scans + node.left_out

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ros_topics, "WAIT_S", 0.0)
        yield send
    live.close()


def _take(node: Node, source: RosSource) -> None:
    """Let a node process what has arrived."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        node.run(source, should_stop=lambda: True)


@pytest.mark.slow
@pytest.mark.parametrize(("topic", "kind"), [(topic, kind) for topic, kinds in WHOLE.items() for kind in kinds])
@settings(max_examples=5, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_whole_messages_after_a_damaged_one_are_taken(topic, kind, data, run):
    whole = WHOLE[topic][kind](BEGIN + 1)
    before = run("/tf_static", TRANSFORMS, b"")
    assert run(topic, kind, data.draw(damaged(whole))) > before
