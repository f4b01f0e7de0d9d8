"""What the live node receives and publishes: scans from a source, loop edges and status for sinks, and reports."""

import contextlib
import math
import sys
import threading
import time
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.scan import Scan

WAIT_S = 0.2
"""Maximum time that `Source.frames` blocks before it yields None, in seconds."""
AGAIN_S = 30.0
"""Minimum time between two printed reports of the same kind, in seconds."""
Report = Callable[[str, str], None]
"""Function of the kind and the text of a warning or note. `Reports` limits how often a kind is printed."""
T = TypeVar("T")


class LiveFrame(NamedTuple):
    """A scan as it arrives."""

    scan: Scan
    """Points in the LiDAR frame, with the mounting if it is known. A scan from a file has a unique name."""
    time: float
    """Time of the message's header, in seconds. 0 or not finite if the header has none."""
    odometry: Float[np.ndarray, "4 4"] | None
    """Pose of the LiDAR by odometry (`world_from_lidar`), or None if it is unknown."""
    received: float
    """Time at which the scan arrived, by `time.monotonic()`, in seconds."""
    is_recorded: bool = False
    """Whether `time` is that of a recording, in which a long pause is no change of the clock."""


class FrameStatus(NamedTuple):
    """Status after a scan was processed."""

    frame: int
    """Number of the scan in the map, from 0."""
    time: float
    """Time of the scan's header, in seconds."""
    seconds: float
    """Time for processing the scan, in seconds."""
    latency_s: float
    """Time from the arrival of the scan to the end of its processing, in seconds."""
    dropped: int
    """Number of scans that were replaced by newer ones before the node took them."""
    places: int
    """Number of stored scans."""
    nbytes: int
    """Memory of the map, in bytes (`LiveMap.nbytes`)."""
    map_from_world: Float[np.ndarray, "4 4"] | None = None
    """Transform from the odometry's frame to the map, by all loops so far. None without odometry or gtsam, and after a
    restart until a loop connects the odometry with that before."""


class LoopEdge(NamedTuple):
    """A loop closure for a pose graph."""

    query: int
    match: int
    """Frame numbers in the map, from 0. The match is the earlier frame."""
    query_time: float
    match_time: float
    """Times of the headers of both scans, in seconds."""
    match_from_query: Float[np.ndarray, "4 4"]
    """Pose of the query's LiDAR in the frame of the match's LiDAR, in metres."""
    covariance: Float[np.ndarray, "6 6"]
    """Covariance of a small motion of the query in its own frame: x, y, z in metres, then rotations in radians."""
    probability: float
    """Probability that both scans show one place."""
    world_from_query: Float[np.ndarray, "4 4"] | None
    world_from_match: Float[np.ndarray, "4 4"] | None
    """Poses of both LiDARs in the odometry frame of the latest scan. None without odometry, and for a scan with
    another odometry frame, such as one before a restart."""
    latency_s: float
    """Time from the arrival of the latest scan to the loop, in seconds. A loop may belong to a scan before it."""
    odometry_frame: int = 0
    """Number of the odometry frame of the latest scan. It changes when the odometry begins in a frame of its own.
    Without odometry, it is the number of the segment of the motion by the scans."""


class LatestScan(Generic[T]):
    """The newest item that a thread received. `put` replaces an item that waits, and counts it as dropped."""

    def __init__(self):
        self.dropped = 0
        """Number of items that were replaced before they were taken."""
        self._item: T | None = None
        self._new_item = threading.Condition()

    def put(self, item: T) -> None:
        """Make this the newest item."""
        with self._new_item:
            self.dropped += self._item is not None
            self._item = item
            self._new_item.notify()

    def take(self, timeout: float) -> T | None:
        """Remove and return the newest item, or return None after `timeout` seconds without one."""
        with self._new_item:
            self._new_item.wait_for(lambda: self._item is not None, timeout)
            item, self._item = self._item, None
            return item


class Reports:
    """Prints the first event of each kind at once. Later ones are counted, and one is printed every `AGAIN_S` seconds.
    An instance is a `Report`. It may be called from several threads."""

    def __init__(self, write: Callable[[str], object] | None = None, *, clock: Callable[[], float] = time.monotonic):
        self._write = write or (lambda text: print(text, file=sys.stderr, flush=True))
        self._clock = clock
        self._printed: dict[str, tuple[float, int]] = {}
        """Time of the last line of each kind, in seconds, and number of events since."""

    def __call__(self, kind: str, text: str) -> None:
        """Print an event, or count it if its kind was printed in the last `AGAIN_S` seconds."""
        now, (printed_at, count) = self._clock(), self._printed.get(kind, (-math.inf, 0))
        if now - printed_at < AGAIN_S:
            self._printed[kind] = printed_at, count + 1
            return
        self._printed[kind] = now, 0
        with contextlib.suppress(OSError, ValueError):  # a closed terminal must not end the node
            self._write(f"{text} ({count} more since the last line)" if count else text)
