"""Loop edges, markers and the transform from map to odometry on ROS topics. The same for DDS, zenoh and rospy."""

import bisect
import time
from collections import deque

import numpy as np
from jaxtyping import Float

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
from sglpr_jax.loops.transforms import inverse

EDGES_KEPT = 1000
"""Number of edges that a subscriber receives that begins late."""
LINES = 500
"""Number of the last loops that are drawn."""


class RosSink:
    """Publishes loops. See `sinks.Sink`.

    The topics are `PREFIX/loops` (`ros_messages.edge_message`), `PREFIX/loop_markers` and `/tf`. The transform from map
    to odometry is the identity until the first loop. After a loop it is the rigid transform that puts the query where
    the loop and the match's corrected pose say. This is no optimised trajectory: the loops before and between are not
    weighed against each other.
    """

    def __init__(self, wire: Wire, options: SinkOptions):
        """Advertise the topics. `close` closes the connection."""
        self._wire, self._options = wire, options
        prefix = full_name(options.prefix)
        self._edges = wire.advertise(f"{prefix}/loops", EDGE, depth=EDGES_KEPT, latched=True)
        self._markers = wire.advertise(f"{prefix}/loop_markers", MARKERS, depth=1, latched=True)
        self._transforms = wire.advertise("/tf", TRANSFORMS, depth=100, latched=False)
        self._lines: deque[np.ndarray] = deque(maxlen=LINES)
        self._corrections = Corrections()

    def frame(self, status: FrameStatus) -> None:
        """Publish the transform from map to odometry at the time of the scan, or now if the scan has no time."""
        at = status.time if np.isfinite(status.time) and status.time > 0 else time.time()
        frames = {"frame": self._options.map_frame, "child": self._options.odometry_frame}
        self._transforms(encode(transform_message(self._corrections.last, time=at, **frames)))

    def loop(self, edge: LoopEdge) -> None:
        """Publish an edge. With odometry of both scans, draw it and correct the transform."""
        self._edges(encode(edge_message(edge)))
        query, match = edge.world_from_query, edge.world_from_match
        if query is None or match is None:
            return
        self._corrections.add(edge, world_from_query=query, world_from_match=match)
        self._lines.append(np.stack([match[:3, 3], query[:3, 3]]))
        drawn = marker_message(list(self._lines), time=edge.query_time, frame=self._options.odometry_frame)
        self._markers(encode(drawn))

    def close(self) -> None:
        """End the connection."""
        self._wire.close()


class Corrections:
    """Transforms from map to odometry, each from a frame on."""

    def __init__(self):
        self._frames: list[int] = []
        self._found: list[np.ndarray] = []

    @property
    def last(self) -> Float[np.ndarray, "4 4"]:
        """The latest `map_from_world`."""
        return self._found[-1] if self._found else np.eye(4)

    def at(self, frame: int) -> Float[np.ndarray, "4 4"]:
        """The `map_from_world` that holds for a frame."""
        row = bisect.bisect_right(self._frames, frame)
        return self._found[row - 1] if row else np.eye(4)

    def add(
        self, edge: LoopEdge, *, world_from_query: Float[np.ndarray, "4 4"], world_from_match: Float[np.ndarray, "4 4"]
    ) -> None:
        """Correct the poses from the query of a loop on. The match has the correction of its own time."""
        map_from_query = self.at(edge.match) @ world_from_match @ edge.match_from_query
        row = bisect.bisect_left(self._frames, edge.query)
        self._frames[row:], self._found[row:] = [edge.query], [map_from_query @ inverse(world_from_query)]
