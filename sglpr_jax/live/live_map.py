"""Map of a running node: the loop detector, with a log on disk from which the next process continues."""

import contextlib
import dataclasses
import json
import os
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import SensorHeight
from sglpr_jax.files import parse_json, read_json, write_json, writing
from sglpr_jax.frame_log import FrameLog
from sglpr_jax.growing import GrowingArray
from sglpr_jax.live.messages import LiveFrame, LoopEdge, Report
from sglpr_jax.live.odometry_input import Clock, Continuity, FirstScans
from sglpr_jax.loops.arguments import as_pose
from sglpr_jax.loops.checkpoint import FRAME_FORMAT, frame_bytes, read_frame
from sglpr_jax.loops.closure import LoopClosure
from sglpr_jax.loops.comparison import Fits
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Keyframe
from sglpr_jax.pose_graph.files import loop_lines, write_loops_jsonl

SETTINGS, FRAMES, LOOPS = "settings.json", "frames.log", "loops.jsonl"
OLD = "journal.bin"
"""File of the scans in maps of earlier versions, which are not read."""
SYNC_S = 5.0
"""Time after which new scans are forced to the disk, in seconds. A loss of power costs at most these scans."""
MOST_WALL_S = 1e8
"""Maximum time between two processes that is believed, in seconds."""
ABOUT = {"name": str, "stamp": float, "time": float, "wall": float, "part": int}
"""JSON values of each scan in the log."""


class LiveScan(NamedTuple):
    """A described scan of a live map."""

    keyframe: Keyframe | None
    """None for a scan that is damaged in the log."""
    compared: Fits | None
    pose: Float[np.ndarray, "4 4"] | None
    """Pose of the LiDAR by odometry."""
    part: int
    """Number of the part of the map. A part begins where the motion since the last scan is unknown."""
    name: str
    """`Scan.name` of the scan."""
    stamp: float
    time: float
    wall: float
    """Times of the header, of `Clock`, and of the computer (since 1970) when the scan was added, in seconds."""


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
          sensor_height: Height in metres, or "auto" to estimate it in the first scans.
          expects_odometry: Whether the first scans wait for odometry.

        Raises:
          ValueError: If the folder has a map of another version, other settings or weights.
          WriteError: If the folder cannot be written.
        """
        self.detector, self._report = detector, report
        self._height: SensorHeight = sensor_height
        self.names: set[str] = set()
        """Names of the scans that have one."""
        self._stamps = GrowingArray(np.empty(0))
        self._poses = GrowingArray(np.empty((0, 4, 4)))
        self._part = 0
        self._clock = Clock(report)
        self._continuity = Continuity(report, expected=expects_odometry)
        self._mounting = FirstScans(sensor_height)
        about = {"format": FRAME_FORMAT, "weights": detector.finder.index.weights_hash, "sensor_height": sensor_height}
        _check_settings(folder, {**about, **dataclasses.asdict(detector.config)})
        self._log: FrameLog | None = FrameLog(folder / FRAMES)
        self._loops_path, self._loops_file = folder / LOOPS, -1
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
        """Add the scans of the log. Returns the loops of an earlier process that it did not write any more.

        A damaged scan becomes a frame without an image. Later scans are then compared anew, because the stored
        comparisons assume its image. Raises ValueError if the log is of another program.
        """
        assert self._log is not None
        scan, lost, known = None, 0, True
        for frame, content in self._log.records():
            keyframe, compared, pose, about = read_frame(content, frame, ABOUT, source=self._log.path)
            scan = LiveScan(keyframe, compared, pose, **about)
            known = scan.part == self._part
            for _ in range(len(self), frame):
                self._extend(scan._replace(keyframe=None, compared=None, name=""))
                lost += 1
            self._extend(scan._replace(compared=None) if lost else scan)
        if lost:
            self._report("lost", f"{self._log.path}: {lost} damaged scans are left out")
        if self._log.cut:
            self._report("cut", f"{self._log.path}: {self._log.cut} bytes of an unfinished scan were removed")
        if scan is not None:
            self._resume(scan, known=known)
        return [self._edge(loop, time.monotonic()) for loop in self._restore_loops()]

    def add(self, frame: LiveFrame) -> list[LoopEdge] | None:
        """Add a scan and return its loops, or None if the scan is left out, which is reported.

        Raises ValueError if the scan or its odometry is invalid.
        """
        scan, pose = frame.scan, as_pose(frame.odometry)
        if scan.points is None or not np.isfinite(scan.points).all(axis=1).any():
            raise ValueError(f"{scan.name or 'scan'}: expected points, found none")
        if scan.mounting is None:
            scan = dataclasses.replace(scan, mounting=self._mounting.see(scan.points))
        keyframe = self.detector.finder.keyframe(scan)  # first, because an invalid scan must not count below
        clock = self._clock.time(frame.time, frame.received)
        placed = self._continuity.placed(pose, clock)
        if placed is None:
            return None
        loops = self.detector.add_keyframe(keyframe, time=clock, odometry=placed.pose, continues=placed.continues)
        compared, stamp, wall = self.detector.finder.fits, float(frame.time), time.time()
        stamp, part = stamp if np.isfinite(stamp) else 0.0, self._part + (not placed.continues)
        described = LiveScan(keyframe, compared, placed.pose, part, scan.name, stamp, clock, wall)
        self._note(described)
        if self.detector.finder.empty[-1]:
            self._report("empty", f"{scan.name or f'scan {len(self) - 1}'}: expected a place, found almost no points")
        self._write(described, loops)
        return [self._edge(loop, frame.received) for loop in loops]

    def close(self) -> None:
        """Force everything to the disk and close the files."""
        if self._loops_file >= 0:
            os.close(self._loops_file)
        if self._log is not None:
            self._log.close()

    def _extend(self, scan: LiveScan) -> None:
        """Add a scan of the log."""
        known = {"fits": scan.compared, "continues": scan.part == self._part}
        self.detector.add_keyframe(scan.keyframe, time=scan.time, odometry=scan.pose, **known)
        self._note(scan)

    def _note(self, scan: LiveScan) -> None:
        self._part = scan.part
        self._stamps.append(scan.stamp)
        if scan.pose is not None:
            self._poses.append(scan.pose)
        if scan.name:
            self.names.add(scan.name)
        self.detector.candidates.clear()  # they are in the log

    def _resume(self, scan: LiveScan, *, known: bool) -> None:
        """Continue after the last scan of an earlier process. `known`: whether the motion up to it is known."""
        passed = min(max(time.time() - scan.wall, 0.0), MOST_WALL_S)
        self._clock.resume(scan.time, scan.stamp, received=time.monotonic() - passed)
        self._continuity.resume(scan.pose, scan.time, known=known)
        assert scan.keyframe is not None
        self._mounting = FirstScans(self._height, known=scan.keyframe.mounting)
        self._report("recall", f"the map continues after {len(self)} scans and {len(self.detector.loops)} loops")

    def _restore_loops(self) -> list[LoopClosure]:
        """Write all loops so far, and return those that the file of an earlier process lacks."""
        written, loops = _pairs(self._loops_path), self.detector.loops
        missed = [loop for loop in loops if (loop.query, loop.match) not in written]
        if missed and written:
            self._report("log", f"{self._loops_path}: {len(missed)} loops were added that the last process missed")
        write_loops_jsonl(self._loops_path, loops)
        with writing(self._loops_path):
            self._loops_file = os.open(self._loops_path, os.O_WRONLY | os.O_APPEND)
        return missed

    def _write(self, scan: LiveScan, loops: list[LoopClosure]) -> None:
        """Write a scan and its loops. After an error the map lives on in memory."""
        if self._log is None:
            return
        try:
            assert scan.compared is not None
            about = {name: getattr(scan, name) for name in ABOUT}
            self._log.append(len(self) - 1, frame_bytes(scan.keyframe, scan.compared, pose=scan.pose, **about))
            with writing(self._loops_path):
                os.write(self._loops_file, loop_lines(loops).encode())
            if time.monotonic() - self._synced > SYNC_S:
                self._log.sync()
                os.fsync(self._loops_file)
                self._synced = time.monotonic()
        except OSError as error:
            self._report("disk", f"{error}; the map is not written any more, and a restart continues before this scan")
            with contextlib.suppress(OSError):
                self._log.close()
            self._log = None

    def _edge(self, loop: LoopClosure, received: float) -> LoopEdge:
        """The loop, with the times of its scans, and their poses if these are in the present frame of the odometry."""
        ends = np.array([loop.query, loop.match])
        known = self.detector.finder.motion.same(-1, ends) & (len(self.odometry) > 0)
        query, match = (self.odometry[one].copy() if ok else None for one, ok in zip(ends, known, strict=True))
        times = float(self._stamps.rows[loop.query]), float(self._stamps.rows[loop.match])
        found = loop.match_from_query, loop.covariance, loop.probability
        return LoopEdge(loop.query, loop.match, *times, *found, query, match, time.monotonic() - received)


def _check_settings(folder: Path, wanted: dict[str, Any]) -> None:
    """Write the settings of a new map, or raise ValueError if those in the folder are others."""
    wanted, path = json.loads(json.dumps(wanted)), folder / SETTINGS
    if (folder / OLD).exists():
        raise ValueError(f"{folder}: expected a map of this version, found {OLD} of an earlier one; use another --out")
    if not (folder / FRAMES).exists():
        return write_json(path, wanted)
    found = read_json(path)
    if not isinstance(found, dict) or found.get("format") != FRAME_FORMAT:
        raise ValueError(
            f"{path}: expected the settings of a live map ({FRAME_FORMAT}), found others; use another --out"
        )
    other = [name for name, value in wanted.items() if not _holds(found.get(name), value)]
    if other:
        raise ValueError(
            f"{path}: expected a map with the same settings, found another {', '.join(other)}; "
            "use the flags and weights of the map, or another --out"
        )


def _holds(found: Any, wanted: Any) -> bool:
    """Whether a stored setting is the wanted one. Maps of earlier versions have fields that are constants today."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        return all(_holds(found.get(name), value) for name, value in wanted.items())
    return found == wanted


def _pairs(path: Path) -> set[tuple[int, int]]:
    """Query and match of each whole line of a file. A line that is cut or damaged is left out."""
    found = set()
    for line in path.read_bytes().splitlines() if path.is_file() else ():
        with contextlib.suppress(ValueError, KeyError, TypeError):
            value = parse_json(line, source=path)
            found.add((value["query"], value["match"]))
    return found
