"""Loop edges, markers and the transform from map to odometry on ROS topics. The same for DDS, zenoh and rospy."""

import time
from collections import deque

import numpy as np

from sglpr_jax.live.frame import FrameStatus, LoopEdge
from sglpr_jax.live.ros_messages import (
    EDGE,
    MARKERS,
    TRANSFORMS,
    edge_message,
    encode,
    marker_message,
    transform_message,
)
from sglpr_jax.live.ros_wire import Wire, full_name
from sglpr_jax.live.sinks import SinkOptions

EDGES_KEPT = 1000
"""Number of edges that a subscriber receives that begins late."""
LINES = 500
"""Number of the last loops that are drawn."""


class RosSink:
    """Publishes loops. See `sinks.Sink`.

    The topics are `PREFIX/loops` (`ros_messages.edge_message`), `PREFIX/loop_markers` and `/tf`. The transform from map
    to odometry is that of the corrected trajectory (`FrameStatus.map_from_world`).
    """

    def __init__(self, wire: Wire, options: SinkOptions):
        """Advertise the topics. `close` closes the connection."""
        self._wire, self._options = wire, options
        prefix = full_name(options.prefix)
        self._edges = wire.advertise(f"{prefix}/loops", EDGE, depth=EDGES_KEPT, latched=True)
        self._markers = wire.advertise(f"{prefix}/loop_markers", MARKERS, depth=1, latched=True)
        self._transforms = wire.advertise("/tf", TRANSFORMS, depth=100, latched=False)
        self._lines: deque[np.ndarray] = deque(maxlen=LINES)

    def frame(self, status: FrameStatus) -> None:
        """Publish the transform from map to odometry at the time of the scan, or now if the scan has no time."""
        if status.map_from_world is None:
            return
        at = status.time if np.isfinite(status.time) and status.time > 0 else time.time()
        frames = {"frame": self._options.map_frame, "child": self._options.odometry_frame}
        self._transforms(encode(transform_message(status.map_from_world, time=at, **frames)))

    def loop(self, edge: LoopEdge) -> None:
        """Publish an edge. With odometry of both scans, draw it."""
        self._edges(encode(edge_message(edge)))
        query, match = edge.world_from_query, edge.world_from_match
        if query is None or match is None:
            return
        self._lines.append(np.stack([match[:3, 3], query[:3, 3]]))
        drawn = marker_message(list(self._lines), time=edge.query_time, frame=self._options.odometry_frame)
        self._markers(encode(drawn))

    def close(self) -> None:
        """End the connection."""
        self._wire.close()
