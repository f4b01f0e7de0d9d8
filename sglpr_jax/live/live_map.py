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
from sglpr_jax.pose_graph.incremental import IncrementalTrajectory

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
    """Comparisons with earlier scans, if they are known."""
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
          expects_odometry: Whether the first scans wait for odometry, and loops correct it.

        Raises:
          ValueError: If the folder has a map of another version, other settings or weights.
          WriteError: If the folder cannot be written.
        """
        self.detector, self._report = detector, report
        self.names: set[str] = set()
        """Names of the scans that have one."""
        self.trajectory: IncrementalTrajectory | None = None
        """Odometry that the loops correct. None without odometry or gtsam."""
        if expects_odometry:
            try:
                self.trajectory = IncrementalTrajectory(drift=detector.config.drift)
            except ImportError as error:
                report("gtsam", f"the map has no transform from map to odometry: {error}")
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

    @property
    def map_from_world(self) -> Float[np.ndarray, "4 4"] | None:
        """Correction of the odometry at the last scan. None without odometry, and while no loop connects the odometry
        with that before a restart."""
        return None if self.trajectory is None or not len(self.trajectory) else self.trajectory.map_from_world

    def recall(self) -> list[LoopEdge]:
        """Add the scans of the log. Returns the loops of an earlier process that it did not write any more.

        A damaged scan becomes a frame without an image. Later scans are then compared anew, because the stored
        comparisons assume its image. Raises ValueError if the log is of another program.
        """
        assert self._log is not None
        scan, damaged, motion_is_known = None, 0, True
        for frame, content in self._log.records():
            keyframe, compared, pose, about = read_frame(content, frame, ABOUT, source=self._log.path)
            scan = LiveScan(keyframe, compared, pose, **about)
            motion_is_known = scan.part == self._part
            for _ in range(len(self), frame):
                self._add(scan._replace(keyframe=None, compared=None, name=""))
                damaged += 1
            self._add(scan._replace(compared=None) if damaged else scan)
        if damaged:
            self._report("lost", f"{self._log.path}: {damaged} damaged scans are left out")
        if self._log.removed_bytes:
            self._report("cut", f"{self._log.path}: {self._log.removed_bytes} bytes of an unfinished scan were removed")
        if scan is not None:
            assert scan.keyframe is not None
            passed = min(max(time.time() - scan.wall, 0.0), MOST_WALL_S)
            self._clock.resume(scan.time, scan.stamp, received=time.monotonic() - passed)
            self._continuity.resume(scan.pose, scan.time, known=motion_is_known)
            self._mounting.resume(scan.keyframe.mounting)
            self._report("recall", f"the map continues after {len(self)} scans and {len(self.detector.loops)} loops")
        return [self._edge(loop, time.monotonic()) for loop in self._restore_loops()]

    def _restore_loops(self) -> list[LoopClosure]:
        """Write all loops so far, and return those that the file of an earlier process lacks."""
        path, loops = self._loops_path, self.detector.loops
        written = _written_pairs(path)
        missed = [loop for loop in loops if (loop.query, loop.match) not in written]
        if missed and written:
            self._report("log", f"{path}: {len(missed)} loops were added that the last process missed")
        write_loops_jsonl(path, loops)
        with writing(path):
            self._loops_file = os.open(path, os.O_WRONLY | os.O_APPEND)
        return missed

    def add(self, frame: LiveFrame) -> list[LoopEdge] | None:
        """Add a scan and return its loops, or None if the scan is left out, which is reported.

        Raises ValueError if the scan or its odometry is invalid.
        """
        scan, pose = frame.scan, as_pose(frame.odometry)
        if scan.points is None or not np.isfinite(scan.points).all(axis=1).any():
            raise ValueError(f"{scan.name or 'scan'}: expected points, found none")
        if scan.mounting is None:
            scan = dataclasses.replace(scan, mounting=self._mounting.add(scan.points))
        keyframe = self.detector.finder.keyframe(scan)  # first, because an invalid scan must not count below
        clock = self._clock.time(frame.time, frame.received)
        state = self._continuity.add(pose, clock)
        if state is None:
            return None
        stamp, part = float(frame.time), self._part + (not state.continues)
        stamp = stamp if np.isfinite(stamp) else 0.0
        described = LiveScan(keyframe, None, state.pose, part, scan.name, stamp, clock, time.time())
        loops = self._add(described)
        if self.detector.finder.empty[-1]:
            self._report("empty", f"{scan.name or f'scan {len(self) - 1}'}: expected a place, found almost no points")
        self._write(described, self.detector.finder.fits, loops)
        return [self._edge(loop, frame.received) for loop in loops]

    def _add(self, scan: LiveScan) -> list[LoopClosure]:
        """Add a scan to the detector and the trajectory, and return the loops that it closes."""
        options = {"fits": scan.compared, "continues": scan.part == self._part}
        loops = self.detector.add_keyframe(scan.keyframe, time=scan.time, odometry=scan.pose, **options)
        self.detector.candidates.clear()  # they are in the log
        self._part = scan.part
        self._stamps.append(scan.stamp)
        if scan.name:
            self.names.add(scan.name)
        if scan.pose is not None:
            self._poses.append(scan.pose)
            if self.trajectory is not None:
                segments = self.detector.finder.motion.segments[-2:]
                ordered = sorted(loops, key=lambda loop: loop.query)
                self.trajectory.add(scan.pose, ordered, continues=bool(segments[0] == segments[-1]))
        return loops

    def _write(self, scan: LiveScan, compared: Fits, loops: list[LoopClosure]) -> None:
        """Write a scan and its loops. After an error the map lives on in memory."""
        if self._log is None:
            return
        try:
            about = {name: getattr(scan, name) for name in ABOUT}
            self._log.append(len(self) - 1, frame_bytes(scan.keyframe, compared, pose=scan.pose, **about))
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

    def close(self) -> None:
        """Force everything to the disk and close the files."""
        if self._loops_file >= 0:
            os.close(self._loops_file)
        if self._log is not None:
            self._log.close()

    def _edge(self, loop: LoopClosure, received: float) -> LoopEdge:
        """The loop, with the times of its scans, and their poses if these are in the present frame of the odometry."""
        ends, segments = np.array([loop.query, loop.match]), self.detector.finder.motion.segments
        in_frame = (segments[ends] == segments[-1]) & (len(self.odometry) > 0)
        query, match = (self.odometry[end].copy() if ok else None for end, ok in zip(ends, in_frame, strict=True))
        times = float(self.stamps[loop.query]), float(self.stamps[loop.match])
        closure = loop.match_from_query, loop.covariance, loop.probability
        return LoopEdge(loop.query, loop.match, *times, *closure, query, match, time.monotonic() - received)


def _check_settings(folder: Path, wanted: dict[str, Any]) -> None:
    """Write the settings of a new map, or raise ValueError if those in the folder are others."""
    wanted, path = json.loads(json.dumps(wanted)), folder / SETTINGS
    if (folder / OLD).exists():
        raise ValueError(f"{folder}: expected a map of this version, found {OLD} of an earlier one; use another --out")
    if not (folder / FRAMES).exists():
        return write_json(path, wanted)
    stored = read_json(path)
    if not isinstance(stored, dict) or stored.get("format") != FRAME_FORMAT:
        raise ValueError(
            f"{path}: expected the settings of a live map ({FRAME_FORMAT}), found others; use another --out"
        )
    other = [name for name, value in wanted.items() if not _includes(stored.get(name), value)]
    if other:
        raise ValueError(
            f"{path}: expected a map with the same settings, found another {', '.join(other)}; "
            "use the flags and weights of the map, or another --out"
        )


def _includes(stored: Any, wanted: Any) -> bool:
    """Whether a stored setting is the wanted one. Maps of earlier versions have fields that are constants today."""
    if isinstance(stored, dict) and isinstance(wanted, dict):
        return all(_includes(stored.get(name), value) for name, value in wanted.items())
    return stored == wanted


def _written_pairs(path: Path) -> set[tuple[int, int]]:
    """Query and match of each whole line of a file. A line that is cut or damaged is left out."""
    pairs = set()
    for line in path.read_bytes().splitlines() if path.is_file() else ():
        with contextlib.suppress(ValueError, KeyError, TypeError):
            loop = parse_json(line, source=path)
            pairs.add((loop["query"], loop["match"]))
    return pairs
