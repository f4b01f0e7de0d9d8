"""The running node: scans from a source, through the map, to sinks. It survives errors of single scans and sinks."""

import dataclasses
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Literal

import numpy as np

from sglpr_jax.files import in_short
from sglpr_jax.live.cloud_scans import CloudScans
from sglpr_jax.live.data_types import FrameStatus, LiveFrame, LoopEdge, Report
from sglpr_jax.live.live_map import LiveMap
from sglpr_jax.live.sources_and_sinks import Sink, Source
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.models.weights import Params
from sglpr_jax.se3 import transform

PROGRESS_S = 10.0
"""Time between two lines about the progress, in seconds."""
TIMED_SCANS = 100
"""Number of latest scans whose mean time is printed."""
WARM_UP_SCANS = 12
"""Number of scans after which every compiled program of the search was used."""


class Node:
    """Takes scans from a source until it ends or `should_stop` is true, and hands the results to the sinks."""

    def __init__(
        self,
        live: LiveMap,
        sinks: Sequence[Sink],
        *,
        report: Report,
        say: Callable[[str], object],
        cloud_scans: CloudScans | None = None,
    ):
        """Connect a map to sinks and, if points are kept, to their folder. `say` prints lines about the progress."""
        self._live, self._sinks, self._report, self._say = live, list(sinks), report, say
        self._cloud_scans = cloud_scans
        self._scan_seconds: deque[float] = deque(maxlen=TIMED_SCANS)
        """Times for processing the latest scans, in seconds."""
        self.scans = self.left_out = self.dropped = self.loops = 0
        """Numbers of scans that were added, left out and dropped, and of loops, since the start."""

    def run(self, source: Source, *, should_stop: Callable[[], bool] = lambda: False) -> None:
        """Process scans. The source and the sinks are not closed."""
        printed_at = time.monotonic()
        for frame in source.frames():
            if frame is not None:
                self.dropped = source.dropped
                self._process(frame)
            if time.monotonic() - printed_at >= PROGRESS_S:
                printed_at = time.monotonic()
                self._say(str(self))
            if should_stop():
                break
        self.dropped = source.dropped

    def publish(self, edges: Iterable[LoopEdge]) -> None:
        """Send loops to the sinks."""
        for edge in edges:
            self.loops += 1
            self._send_to_sinks("loop", edge)

    def __str__(self) -> str:
        rate = f", {1000 * float(np.mean(self._scan_seconds)):.0f} ms a scan" if self._scan_seconds else ""
        memory = f"{self._live.nbytes / 1e6:.0f} MB"
        return (
            f"{self.scans} scans{rate}, {self.dropped} dropped, {self.left_out} left out, {self.loops} loops; "
            f"the map has {len(self._live)} scans, {memory}"
        )

    def _process(self, frame: LiveFrame) -> None:
        """Add a scan to the map and send its loops and the status to the sinks. A scan with an error is reported."""
        begin = time.monotonic()
        try:
            edges = self._live.add(frame)
        except Exception as error:  # whatever a scan holds, the node lives on
            self._report("scan", f"a scan is left out: {in_short(error, most=300)}")
            edges = None
        if edges is None:
            self.left_out += 1
            return
        self.publish(edges)
        end = time.monotonic()
        self.scans += 1
        self._scan_seconds.append(end - begin)
        status = FrameStatus(
            frame=len(self._live) - 1,
            time=frame.time,
            seconds=end - begin,
            latency_s=end - frame.received,
            dropped=self.dropped,
            places=len(self._live.detector.finder.stored),
            nbytes=self._live.nbytes,
            map_from_world=self._live.map_from_world,
        )
        self._send_to_sinks("frame", status)
        if self._cloud_scans is not None:  # after the loops are published, because it writes to the disk
            self._cloud_scans.add(frame.scan)

    def _send_to_sinks(self, method: Literal["frame", "loop"], message: FrameStatus | LoopEdge) -> None:
        """Call `method` of every sink with a message. A sink that fails is reported and not used again."""
        for sink in list(self._sinks):
            try:
                getattr(sink, method)(message)
            except Exception as error:  # a sink may use any library
                self._sinks.remove(sink)
                self._report(f"sink {id(sink)}", f"{type(sink).__name__} is left out: {in_short(error, most=300)}")


def warm_up(params: Params, config: DetectorConfig, *, odometry: bool) -> None:
    """Compile all programs of the search with random scans, so that no scan of the source is dropped meanwhile."""
    # Thresholds with which all scans are compared, coarsely and exactly.
    accept_all = {"recent_m": 1e-9, "good_correlation": 2.0, "min_coarse_correlation": -1.0, "min_correlation": -1.0}
    candidates = dataclasses.replace(config.candidates, **accept_all)
    config = dataclasses.replace(config, candidates=candidates, max_places=None, keyframe_m=0.0)
    detector = LoopDetector(params, config=config)
    rng = np.random.default_rng(0)
    for i in range(WARM_UP_SCANS):
        points = rng.uniform((-20, -20, -1), (20, 20, 3), (4000, 3)).astype(np.float32)
        detector.add(points, time=0.7 * i, odometry=transform(0.01 * i, 0.0, 0.0) if odometry else None)
