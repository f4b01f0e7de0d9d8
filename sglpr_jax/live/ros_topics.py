"""ROS topics as source of scans and odometry and as sink of loops, over any connection to ROS (DDS, zenoh, rclpy)."""

import dataclasses
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.ros_messages import Header
from sglpr_jax.data.scan import Scan
from sglpr_jax.files import in_short
from sglpr_jax.live.data_types import WAIT_S, FrameStatus, LatestScan, LiveFrame, LoopEdge, Report
from sglpr_jax.live.options import LiveOptions
from sglpr_jax.live.ros_encoding import (
    CLOUD_TYPES,
    EDGE,
    MARKERS,
    TRANSFORMS,
    Received,
    decode_cloud,
    edge_message,
    marker_message,
    transform_message,
)
from sglpr_jax.live.ros_odometry import ODOMETRY_TYPES, LiveOdometry

DEFAULT_CLOUD_TOPIC = "/points"
STATIC_TOPIC = "/tf_static"
MISSING_S = 5.0
"""Time without scans after which the existing topics are reported, in seconds. It is also the time between reports."""
TAKEOVER_S = 2.0
"""Time without scans of a publisher after which those of another one are used, in seconds."""
POSE_QUEUE = 100
"""Maximum number of messages with poses that wait for the thread of the connection."""
SCAN_QUEUE = 3
"""Maximum number of messages with scans that wait for the thread of the connection, which leaves out invalid ones."""
EDGE_HISTORY = 1000
"""Maximum number of past edges that a late subscriber receives."""
MAX_DRAWN_LOOPS = 500
"""Maximum number of loops that are drawn, the latest ones."""
Receive = Callable[[Received], None]
"""Function that is called with each message, in a thread of the connection. It must return before the next scan."""


@runtime_checkable
class Transport(Protocol):
    """A connection to ROS. Topics and types have the names that `ros2 topic list -t` prints."""

    def subscribe(
        self, topic: str, kinds: Collection[str], receive: Receive, *, depth: int, reliable: bool, latched: bool
    ) -> None:
        """Call `receive` with each message of a topic that has one of the types `kinds`. At most `depth` messages wait.
        `reliable` requests lost messages again, `latched` requests earlier messages."""

    def advertise(self, topic: str, kind: str, *, depth: int, latched: bool) -> Callable[[bytes], None]:
        """Return a function that publishes encoded messages (CDR) of one type. With `latched`, later subscribers
        receive the last `depth` messages."""
        ...

    def published(self) -> dict[str, set[str]]:
        """Return the types of each topic that has a publisher."""
        ...

    def close(self) -> None: ...


class RosSource:
    """Source of the scans of a topic, with poses from a topic of odometry if `options` name one."""

    def __init__(self, transport: Transport, options: LiveOptions, report: Report):
        """Subscribe to the topics. After `MISSING_S` seconds without scans, the existing topics are reported."""
        self.topic = absolute_topic(options.topic or DEFAULT_CLOUD_TOPIC)
        self._transport, self._report = transport, report
        self._latest: LatestScan[tuple[Header, Scan, float]] = LatestScan()
        self._publisher, self._taken = None, -np.inf
        """Publisher of the last valid scan, and time of its arrival by `time.monotonic()`, in seconds."""
        self._received = self._reported = time.monotonic()
        self._closed = threading.Event()
        transport.subscribe(
            self.topic, CLOUD_TYPES, self._receive, depth=SCAN_QUEUE, reliable=options.reliable, latched=False
        )
        self._last, self._late = -np.inf, None
        """Header time of the last scan with a pose, and of the last scan if it was before that, in seconds."""
        self._odometry = None
        if options.odometry_topic is not None:
            odometry = self._odometry = LiveOdometry(absolute_topic(options.odometry_topic), report)
            transport.subscribe(
                odometry.topic, ODOMETRY_TYPES, odometry.receive, depth=POSE_QUEUE, reliable=False, latched=False
            )
            static = odometry.receive_static
            transport.subscribe(STATIC_TOPIC, (TRANSFORMS,), static, depth=POSE_QUEUE, reliable=True, latched=True)

    def frames(self) -> Iterator[LiveFrame | None]:
        while not self._closed.is_set():
            scan = self._latest.take(WAIT_S)
            if scan is None:
                self._report_silence()
            try:
                frame = None if scan is None else self._frame(*scan)
            except Exception as error:  # whatever a message holds, the source lives on
                frame = self._report("message", f"{self.topic}: a scan is left out: {in_short(error, most=300)}")
            yield frame

    def close(self) -> None:
        self._closed.set()
        self._transport.close()

    @property
    def dropped(self) -> int:
        return self._latest.dropped

    def _receive(self, message: Received) -> None:
        """Keep a valid scan for `frames`, unless another publisher than the one in use sent it. Invalid ones are left
        out here, so that they neither replace a valid one that waits nor keep other publishers out."""
        if message.publisher != self._publisher and message.at - self._taken < TAKEOVER_S:
            expected = f"{self.topic}: expected one publisher"
            return self._report("publishers", f"{expected}, found several; the scans of the first are used")
        self._received = message.at
        try:
            header, scan = decode_cloud(message.raw, message.kind)
        except ValueError as error:
            return self._report("cloud", f"{self.topic}: {error}")
        self._publisher, self._taken = message.publisher, message.at
        self._latest.put((header, scan, message.at))

    def _frame(self, header: Header, scan: Scan, received: float) -> LiveFrame:
        """Find the pose of a scan that arrived at the time `received`."""
        pose = None if self._odometry is None else self._pose(header, self._odometry)
        return LiveFrame(dataclasses.replace(scan, time=header.time), header.time, pose, received)

    def _pose(self, header: Header, odometry: LiveOdometry) -> Float[np.ndarray, "4 4"] | None:
        """Find the pose of a scan. A single scan with a time before that of the last one has none: its time is wrong.
        A second one shows that the clock has changed."""
        late, self._late = self._late, None
        if header.time < self._last and (late is None or header.time < late):
            self._late = header.time
            found = f"found one {self._last - header.time:.1f} s before the last one; its pose is unknown"
            return self._report("order", f"{self.topic}: expected scans in order, {found}")
        pose = odometry.pose(header.time, header.frame, wait_s=WAIT_S)
        self._last = self._last if pose is None else header.time
        return pose

    def _report_silence(self) -> None:
        """Report existing topics and types if no scan arrived, and nothing was reported, for `MISSING_S` seconds."""
        now = time.monotonic()
        if now - max(self._received, self._reported) < MISSING_S:
            return
        self._reported = now
        topics = {topic: sorted(kinds) for topic, kinds in sorted(self._transport.published().items())}
        kinds = topics.get(self.topic, [])
        expected = f"{self.topic}: expected {' or '.join(CLOUD_TYPES)}"
        if not set(CLOUD_TYPES).isdisjoint(kinds):
            silence = f"found a publisher but no message for {now - self._received:.0f} s"
            self._report("silent", f"{expected}, {silence}; waiting")
        elif kinds:
            self._report("type", f"{expected}, found {', '.join(kinds)}; waiting")
        else:
            others = ", ".join(f"{topic} ({' '.join(kinds)})" for topic, kinds in topics.items())
            self._report("missing", f"{expected}, found no such topic; existing topics: {others or 'none'}; waiting")


class RosSink:
    """Publishes loops on `PREFIX/loops` (`edge_message`), draws them on `PREFIX/loop_markers`, and publishes the
    transform from map to odometry of the corrected trajectory (`FrameStatus.map_from_world`) on `/tf`."""

    def __init__(self, transport: Transport, options: LiveOptions):
        """Advertise the topics. `close` closes the connection."""
        self._transport, self._options = transport, options
        prefix = absolute_topic(options.topic_prefix)
        self._publish_edge = transport.advertise(f"{prefix}/loops", EDGE, depth=EDGE_HISTORY, latched=True)
        self._publish_markers = transport.advertise(f"{prefix}/loop_markers", MARKERS, depth=1, latched=True)
        self._publish_transform = transport.advertise("/tf", TRANSFORMS, depth=100, latched=False)
        self._loop_ends: deque[np.ndarray] = deque(maxlen=MAX_DRAWN_LOOPS)
        """Positions (2, 3) of match and query of the last loops, in metres in the odometry frame of the last loop."""
        self._odometry_frame = 0  # `LoopEdge.odometry_frame` of the last loop

    def frame(self, status: FrameStatus) -> None:
        """Publish the transform from map to odometry at the time of the scan, or now if the scan has no time."""
        if status.map_from_world is None:
            return
        stamp = status.time if np.isfinite(status.time) and status.time > 0 else time.time()
        frames = {"frame": self._options.map_frame, "child": self._options.odometry_frame}
        self._publish_transform(transform_message(status.map_from_world, time=stamp, **frames))

    def loop(self, edge: LoopEdge) -> None:
        """Publish an edge. Publish the lines of the latest loops, too, if both scans have odometry or if the odometry
        frame has changed. The first loop in a new odometry frame deletes the lines in the earlier one."""
        self._publish_edge(edge_message(edge))
        query_pose, match_pose = edge.world_from_query, edge.world_from_match
        has_changed = edge.odometry_frame != self._odometry_frame
        if has_changed:
            self._odometry_frame = edge.odometry_frame
            self._loop_ends.clear()
        if query_pose is not None and match_pose is not None:
            self._loop_ends.append(np.stack([match_pose[:3, 3], query_pose[:3, 3]]))
            has_changed = True
        if has_changed:
            frame = self._options.odometry_frame
            self._publish_markers(marker_message(list(self._loop_ends), time=edge.query_time, frame=frame))

    def close(self) -> None:
        self._transport.close()


def absolute_topic(topic: str) -> str:
    """Return the name of a topic with a slash at its beginning."""
    return f"/{topic.strip('/')}"


def domain_of(where: str, *, source: str) -> int:
    """Return the number of a ROS 2 domain: `where`, or else the environment variable ROS_DOMAIN_ID, or else 0. Raises
    ValueError, naming the `source`, if it is not from 0 to 232."""
    text = where or os.environ.get("ROS_DOMAIN_ID") or "0"
    if not (text.isdecimal() and int(text) <= 232):
        raise ValueError(f"{source}: expected a ROS 2 domain from 0 to 232, found {text}")
    return int(text)


def wire_type(kind: str) -> str:
    """Return the DDS name of a ROS type: `sensor_msgs::msg::dds_::PointCloud2_` for `sensor_msgs/msg/PointCloud2`."""
    package, folder, name = kind.split("/")
    return f"{package}::{folder}::dds_::{name}_"


def ros_type(name: str) -> str:
    """Return the ROS name of a type from its DDS name, the inverse of `wire_type`."""
    return name.removesuffix("_").replace("::dds_::", "::").replace("::", "/")
