"""A process of this project's Python with the source or the sink of ROS 1. rospy stays out of the process of the tests.

Usage: ros1_ours.py source | sink | another. It prints results as a line of JSON, and reports on stderr.
"""

import itertools
import json
import sys
import time

import numpy as np

from sglpr_jax.live.frame import FrameStatus
from sglpr_jax.live.sinks import SinkOptions, open_sink
from sglpr_jax.live.sources import SourceOptions, open_source
from tests.live.messages import Said
from tests.live.test_ros_messages import edge

SAID = Said()


def source() -> dict:
    """The first scan with a pose, or nothing if the topic is reported to have another type."""
    found = open_source("ros1", SourceOptions(odometry_topic="odometry"), SAID)
    found._missing_s = 0.5  # pyright: ignore
    for frame in found.frames():
        if "type" in SAID or (frame is not None and frame.odometry is not None):
            topics = {topic: sorted(kinds) for topic, kinds in found._wire.published().items()}  # pyright: ignore
            found.close()
            scan = (frame.time, frame.record.points.tolist(), frame.odometry.tolist()) if frame else None
            return {"scan": scan, "topics": topics}
    raise AssertionError


def sink() -> dict:
    """Publish three loops before there is a subscriber, and the status of scans until the process is killed."""
    found = open_sink("ros1", SinkOptions(), SAID)
    for query in range(3):
        found.loop(edge()._replace(query=query))
    for frame in itertools.count():
        found.frame(FrameStatus(frame, 50.0, 0.01, 0.02, 0, 5, 100, np.eye(4)))
        time.sleep(0.05)
    raise AssertionError


def another() -> dict:
    """Use a second roscore."""
    open_source("ros1", SourceOptions(), SAID).close()
    open_source("ros1:http://other:11311", SourceOptions(), SAID)
    raise AssertionError


if __name__ == "__main__":
    print(json.dumps({**{"source": source, "sink": sink, "another": another}[sys.argv[1]](), "said": SAID}), flush=True)
