"""Scans, and poses by odometry, from ROS topics. The same for DDS, zenoh and rospy."""

import threading
import time
from collections.abc import Iterator

from sglpr_jax.data.recording import found_record
from sglpr_jax.live.frame import LiveFrame
from sglpr_jax.live.latest import Latest
from sglpr_jax.live.report import Report
from sglpr_jax.live.ros_messages import CLOUDS, TRANSFORMS, decode_cloud
from sglpr_jax.live.ros_odometry import KINDS, LiveOdometry
from sglpr_jax.live.ros_wire import Received, Wire, full_name
from sglpr_jax.live.sources import WAIT_S, SourceOptions

CLOUD_TOPIC = "/points"
STATIC_TOPIC = "/tf_static"
MISSING_S = 5.0
"""Time without scans after which the existing topics are reported, in seconds. It is also the time between reports."""
TAKEN_OVER_S = 2.0
"""Time after which another publisher may take the place of one that is silent, in seconds."""
POSES_KEPT = 100
"""Number of messages with poses that wait for the thread of the connection."""


class RosSource:
    """Source of the scans of a topic. See `sources.Source`."""

    def __init__(self, wire: Wire, options: SourceOptions, report: Report, *, missing_s: float = MISSING_S):
        """Subscribe to the topics.

        Arguments:
          wire: Open connection. `close` closes it.
          options: Topics, and whether lost scans are requested again.
          report: Function for trouble with single messages.
          missing_s: Time without scans after which the existing topics are reported, in seconds.
        """
        self.topic = full_name(options.topic or CLOUD_TOPIC)
        self._wire, self._report, self._missing_s = wire, report, missing_s
        self._latest: Latest[Received] = Latest()
        self._publisher = None
        self._heard = self._reported = time.monotonic()
        self._closed = threading.Event()
        wire.subscribe(self.topic, CLOUDS, self._receive, depth=1, reliable=options.reliable, latched=False)
        self._odometry = self._subscribed(options.odometry_topic)

    def _subscribed(self, topic: str | None) -> LiveOdometry | None:
        if topic is None:
            return None
        odometry = LiveOdometry(full_name(topic), self._report)
        many = {"depth": POSES_KEPT, "reliable": False}
        self._wire.subscribe(odometry.topic, KINDS, odometry.receive, **many, latched=False)
        fixed = {"depth": POSES_KEPT, "reliable": True}
        self._wire.subscribe(STATIC_TOPIC, (TRANSFORMS,), odometry.receive_static, **fixed, latched=True)
        return odometry

    def frames(self) -> Iterator[LiveFrame | None]:
        """Yield scans as they arrive, and None after each `WAIT_S` seconds without a scan."""
        while not self._closed.is_set():
            message = self._latest.take(WAIT_S)
            if message is None:
                self._look()
            yield None if message is None else self._frame(message)

    def close(self) -> None:
        """End the connection."""
        self._closed.set()
        self._wire.close()

    @property
    def dropped(self) -> int:
        """Number of scans that were replaced by newer ones before they were taken."""
        return self._latest.dropped

    def _receive(self, message: Received) -> None:
        """Keep the scan, if it is of the publisher in use."""
        if message.publisher != self._publisher:
            if self._publisher is not None and message.at - self._heard < TAKEN_OVER_S:
                found = "found several; the scans of the first are used"
                self._report("publishers", f"{self.topic}: expected one publisher, {found}")
                return
            self._publisher = message.publisher
        self._heard = message.at
        self._latest.put(message)

    def _frame(self, message: Received) -> LiveFrame | None:
        """Decode a scan and find its pose. Returns None, with a report, for an invalid scan."""
        try:
            header, records = decode_cloud(message.raw, message.kind, cdr=message.cdr)
        except ValueError as error:
            self._report("cloud", f"{self.topic}: {error}")
            return None
        pose = None
        if self._odometry is not None:
            pose = self._odometry.pose(header.time, header.frame.strip("/"), wait_s=WAIT_S)
        return LiveFrame(found_record(records, lasers=False, time=header.time), header.time, pose, message.at)

    def _look(self) -> None:
        """Report which topics exist if no scans arrive."""
        now = time.monotonic()
        if now - max(self._heard, self._reported) < self._missing_s:
            return
        self._reported = now
        found = self._wire.published()
        kinds = found.get(self.topic, set())
        wanted = f"{self.topic}: expected {' or '.join(CLOUDS)}"
        if kinds & set(CLOUDS):
            self._report("silent", f"{wanted}, found a publisher but no message for {now - self._heard:.0f} s; waiting")
        elif kinds:
            self._report("type", f"{wanted}, found {', '.join(sorted(kinds))}; waiting")
        else:
            others = ", ".join(f"{topic} ({' '.join(sorted(kinds))})" for topic, kinds in sorted(found.items()))
            self._report("missing", f"{wanted}, found no such topic; existing topics: {others or 'none'}; waiting")
