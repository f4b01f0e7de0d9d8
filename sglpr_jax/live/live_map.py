"""Map of a running node: the loop detector with a journal on disk, from which the next process continues."""

import contextlib
import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import SensorHeight
from sglpr_jax.growing import GrowingArray
from sglpr_jax.live.clock import Clock
from sglpr_jax.live.continuity import Continuity
from sglpr_jax.live.frame import LiveFrame, LoopEdge
from sglpr_jax.live.journal import Journal
from sglpr_jax.live.loop_log import LoopLog
from sglpr_jax.live.mounting import FirstScans
from sglpr_jax.live.report import Report
from sglpr_jax.live.scan_bytes import LiveScan, from_bytes, to_bytes
from sglpr_jax.loops.arguments import given_pose
from sglpr_jax.loops.closure import Loop
from sglpr_jax.loops.detector import LoopDetector

FORMAT = "sglpr-jax live 3"
JOURNAL, LOOPS = "journal.bin", "loops.jsonl"
SYNC_S = 5.0
"""Time after which new scans are forced to the disk, in seconds. A loss of power costs at most these scans."""
MOST_WALL_S = 1e8
"""Maximum time between two processes that is believed, in seconds."""


class LiveMap:
    """Loop detector whose scans and loops are on disk before they are returned.

    Example:
      live = LiveMap(LoopDetector(params), Path("found"), report=Reports())
      missed = live.recall()          # loops of an earlier process that were not written
      edges = live.add(frame)         # for each LiveFrame
      live.close()
    """

    def __init__(
        self,
        detector: LoopDetector,
        folder: Path,
        *,
        report: Report,
        sensor_height: SensorHeight = "auto",
        expects_odometry: bool = False,
    ):
        """Open the map in a folder, or begin one.

        Arguments:
          detector: Detector without frames.
          folder: Folder of the map.
          report: Function for events that need no action.
          sensor_height: Height of the sensor in metres, or "auto" to estimate it in the first scans.
          expects_odometry: Whether the first scans wait for odometry.

        Raises:
          ValueError: If the folder has a map of other settings or weights.
          WriteError: If the folder cannot be written.
        """
        self.detector, self._report = detector, report
        self._height: SensorHeight = sensor_height
        self.names: set[str] = set()
        """Names of the scans that have one."""
        self._stamps = GrowingArray(np.empty(0))
        self._poses = GrowingArray(np.empty((0, 4, 4)))
        self._clock = Clock(report)
        self._continuity = Continuity(report, expected=expects_odometry)
        self._mounting = FirstScans(sensor_height)
        self._journal: Journal | None = Journal(folder / JOURNAL, _settings(detector, sensor_height))
        self._log = LoopLog(folder / LOOPS, report)
        self._synced = time.monotonic()

    def __len__(self) -> int:
        return len(self.detector)

    @property
    def stamps(self) -> Float[np.ndarray, " n"]:
        """Time of the header of each scan, in seconds."""
        return self._stamps.rows

    @property
    def odometry(self) -> Float[np.ndarray, "n 4 4"]:
        """Pose of the LiDAR at each scan by odometry. Empty without odometry."""
        return self._poses.rows

    def recall(self) -> list[LoopEdge]:
        """Add the scans of the journal. Returns the loops of an earlier process that it did not write any more.

        Raises ValueError if a scan of the journal is invalid.
        """
        assert self._journal is not None
        scan = None
        for content in self._journal.records():
            scan = from_bytes(content, len(self), source=self._journal.path)
            self._extend(scan)
        if self._journal.cut:
            self._report("cut", f"{self._journal.path}: {self._journal.cut} bytes of an unfinished scan were removed")
        if scan is not None:
            self._resume(scan)
        missed = self._log.restore(self.detector.loops)
        return [self._edge(loop, time.monotonic()) for loop in missed]

    def add(self, frame: LiveFrame) -> list[LoopEdge] | None:
        """Add a scan and return its loops, or None if the scan is left out, which is reported.

        Raises ValueError if the scan or its odometry is invalid.
        """
        record, pose = frame.record, given_pose(frame.odometry)
        if record.points is None or not np.isfinite(record.points).all(axis=1).any():
            raise ValueError(f"{record.name or 'scan'}: expected points, found none")
        if record.mounting is None:
            record = dataclasses.replace(record, mounting=self._mounting.see(record.points))
        seen = self.detector.finder.seen(record)  # first, because an invalid scan must not count below
        clock = self._clock.time(frame.time, frame.received)
        placed = self._continuity.placed(pose, clock)
        if placed is None:
            return None
        loops = self.detector.add_seen(seen, time=clock, odometry=placed.pose, continues=placed.continues)
        compared, stamp, wall = self.detector.finder.compared, float(frame.time), time.time()
        stamp = stamp if np.isfinite(stamp) else 0.0
        scan = LiveScan(seen, compared, placed.pose, placed.continues, record.name, stamp, clock, wall)
        self._note(scan)
        if self.detector.finder.empty[-1]:
            self._report("empty", f"{record.name or f'scan {len(self) - 1}'}: expected a place, found almost no points")
        self._write(scan, loops)
        return [self._edge(loop, frame.received) for loop in loops]

    def close(self) -> None:
        """Force everything to the disk and close the files."""
        self._log.close()
        if self._journal is not None:
            self._journal.close()

    def _extend(self, scan: LiveScan) -> None:
        self.detector.add_seen(
            scan.seen, time=scan.time, odometry=scan.pose, compared=scan.compared, continues=scan.continues
        )
        self._note(scan)

    def _note(self, scan: LiveScan) -> None:
        self._stamps.append(scan.stamp)
        if scan.pose is not None:
            self._poses.append(scan.pose)
        if scan.name:
            self.names.add(scan.name)
        self.detector.candidates.clear()  # they are in the journal

    def _resume(self, scan: LiveScan) -> None:
        """Continue after the last scan of an earlier process."""
        passed = min(max(time.time() - scan.wall, 0.0), MOST_WALL_S)
        self._clock.resume(scan.time, scan.stamp, received=time.monotonic() - passed)
        self._continuity.resume(scan.pose, scan.time, known=scan.continues)
        self._mounting = FirstScans(self._height, known=scan.seen.mounting)
        self._report("recall", f"the map continues after {len(self)} scans and {len(self.detector.loops)} loops")

    def _write(self, scan: LiveScan, loops: list[Loop]) -> None:
        """Write a scan and its loops. After an error the map lives on in memory."""
        if self._journal is None:
            return
        try:
            self._journal.append(to_bytes(scan))
            self._log.append(loops)
            if time.monotonic() - self._synced > SYNC_S:
                self._journal.sync()
                self._log.sync()
                self._synced = time.monotonic()
        except OSError as error:
            self._report("disk", f"{error}; the map is not written any more, and a restart continues before this scan")
            with contextlib.suppress(OSError):
                self._journal.close()
            self._journal = None

    def _edge(self, loop: Loop, received: float) -> LoopEdge:
        """The loop, with the times of its scans, and their poses if these are in the present frame of the odometry."""
        ends = np.array([loop.query, loop.match])
        known = self.detector.finder.motion.same(-1, ends) & (len(self.odometry) > 0)
        query, match = (self.odometry[one].copy() if ok else None for one, ok in zip(ends, known, strict=True))
        times = float(self._stamps.rows[loop.query]), float(self._stamps.rows[loop.match])
        found = loop.match_from_query, loop.covariance, loop.probability
        return LoopEdge(loop.query, loop.match, *times, *found, query, match, time.monotonic() - received)


def _settings(detector: LoopDetector, height: SensorHeight) -> dict[str, Any]:
    """Settings that determine the content of a map."""
    about = {"format": FORMAT, "weights": detector.finder.index.weights_hash, "sensor_height": height}
    return {**about, **dataclasses.asdict(detector.config)}
