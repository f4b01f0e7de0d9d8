"""Map of the live node: a loop detector with a log on disk, from which the next process continues."""

import contextlib
import dataclasses
import os
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import SensorHeight
from sglpr_jax.data.poses import as_pose
from sglpr_jax.files import append_whole, raising_write_error, write_bytes
from sglpr_jax.frame_log import FrameLog
from sglpr_jax.growing import GrowingArray
from sglpr_jax.live.data_types import LiveFrame, LoopEdge, Report
from sglpr_jax.live.odometry_input import FixedMounting, OdometryContinuity, OdometryState, ScanClock
from sglpr_jax.loops.candidates import agree
from sglpr_jax.loops.checkpoint import FRAME_FORMAT, frame_bytes, read_frame
from sglpr_jax.loops.closure import LoopClosure
from sglpr_jax.loops.comparison import NO_FITS, Fits
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Keyframe
from sglpr_jax.pose_graph.files import LOOPS_JSONL, loop_lines, read_loops_jsonl
from sglpr_jax.pose_graph.incremental import IncrementalTrajectory

FRAMES_LOG = "frames.log"
SYNC_S = 5.0
"""Time after which new scans are forced to the disk, in seconds. A loss of power costs at most these scans."""
MAX_PAUSE_S = 1e8
"""Maximum time between two processes, in seconds. If clocks state a longer one, this value is used."""
ABOUT = {"name": str, "stamp": float, "time": float, "wall": float, "part": int, "is_keyframe": bool, "by_scans": bool}
"""Fields of `LiveScan` that are JSON values of each scan in the log."""


class LiveScan(NamedTuple):
    """A scan of a live map, as the log stores it."""

    keyframe: Keyframe | None
    """Descriptor and image. None for a scan that is not a keyframe, and for one that is damaged in the log."""
    compared: Fits | None
    """Comparisons with earlier scans. None if they must be computed."""
    pose: Float[np.ndarray, "4 4"] | None
    """Pose of the LiDAR by odometry or, while that is missing, by the scans."""
    by_scans: bool
    """Whether the scans showed the pose, because odometry was missing."""
    part: int
    """Number of the scan's part of the drive. A new part begins where the motion since the last scan is unknown."""
    is_keyframe: bool
    """Whether the scan is searched for loops (`CandidateSearch.is_due`)."""
    name: str
    """`Scan.name` of the scan."""
    stamp: float
    time: float
    wall: float
    """Times of the header, of `ScanClock`, and of the computer (since 1970) when the scan was added, in seconds."""


class LiveMap:
    """Loop detector that writes each scan and its loops to disk before it returns the loops.

    Example:
      live = LiveMap(LoopDetector(params), Path("found"), report=Reports())
      missed = live.restore()         # loops of an earlier process that were not written
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
          report: Function that receives warnings and notes (`Reports`).
          sensor_height: Height in metres, or "auto" to estimate it in the first scans.
          expects_odometry: Whether the first scans wait for odometry, and loops correct it.

        Raises:
          ValueError: If the folder has a map of another version, other settings or weights.
          WriteError: If the folder cannot be written.
        """
        self.detector, self._report = detector, report
        self.names: set[str] = set()
        """Names of the scans that have one."""
        self._name_bytes = 0  # of all names
        self.trajectory: IncrementalTrajectory | None = None
        """Odometry that the loops correct. None without odometry or gtsam."""
        if expects_odometry:
            try:
                self.trajectory = IncrementalTrajectory(drift=detector.config.drift)
            except ImportError as error:
                report("gtsam", f"the map has no transform from map to odometry: {error}")
        self._stamps = GrowingArray(np.empty(0))
        self._poses = GrowingArray(np.empty((0, 4, 4)))
        self._part = 0  # `LiveScan.part` of the last scan
        self._is_by_scans = False  # `LiveScan.by_scans` of the last scan
        self._clock = ScanClock(report)
        self._continuity = OdometryContinuity(report, expected=expects_odometry)
        self._mounting = FixedMounting(sensor_height)
        about = {"format": FRAME_FORMAT, "weights": detector.finder.index.weights_hash, "sensor_height": sensor_height}
        settings = {**about, **dataclasses.asdict(detector.config)}
        self._log: FrameLog | None = FrameLog(folder / FRAMES_LOG, settings)
        self._loops_path, self._loops_file = folder / LOOPS_JSONL, -1
        self._synced_at = time.monotonic()

    def __len__(self) -> int:
        return len(self.detector)

    @property
    def nbytes(self) -> int:
        """Number of bytes of detector, names, times, odometry and its correction, without the memory of programs."""
        parts = [self.detector, self._stamps, self._poses, *([] if self.trajectory is None else [self.trajectory])]
        return self._name_bytes + sum(part.nbytes for part in parts)

    @property
    def loops(self) -> list[LoopClosure]:
        """All loops: those of the file and, if it cannot be written any more, those of the detector that it lacks."""
        written = self._written_loops()
        return [*written, *_missing(self.detector.loops, written)]

    @property
    def stamps(self) -> Float[np.ndarray, " n"]:
        """Time of the header of each scan, in seconds."""
        return self._stamps.rows

    @property
    def odometry(self) -> Float[np.ndarray, "n 4 4"]:
        """Pose of the LiDAR at each scan by odometry or, while it is missing, by the scans. Empty without odometry."""
        return self._poses.rows

    @property
    def map_from_world(self) -> Float[np.ndarray, "4 4"] | None:
        """Transform from the odometry's frame to the map at the last scan. None without odometry, without gtsam, and
        after a restart until a loop connects the odometry with that before."""
        return None if self.trajectory is None or not len(self.trajectory) else self.trajectory.map_from_world

    def restore(self) -> list[LoopEdge]:
        """Add the scans of the log. Returns the loops that the earlier process found but did not write.

        A damaged scan becomes a frame without an image. Later scans are then compared anew, because the stored
        comparisons use its image. Raises ValueError if another program wrote the log.
        """
        assert self._log is not None
        loops, scan, damaged, motion_is_known = list[LoopClosure](), None, 0, True
        for frame in range(self._log.end):
            content = self._log.record(frame)
            if content is None:
                continue
            keyframe, compared, pose, about = read_frame(content, frame, ABOUT, source=self._log.path)
            scan = LiveScan(keyframe, compared, pose, **about)
            motion_is_known = scan.part == self._part
            for _ in range(len(self), frame):  # frames that are missing in the log
                loops += self._add(scan._replace(keyframe=None, is_keyframe=True, compared=None, name=""))
                damaged += 1
            loops += self._add(scan._replace(compared=None) if damaged else scan)
        if self._log.damaged_bytes:
            found = f"{self._log.damaged_bytes} damaged or unfinished bytes; scans lost before the last one: {damaged}"
            self._report("damaged", f"{self._log.path}: expected whole scans, found {found}")
        if scan is not None:
            pause_s = min(max(time.time() - scan.wall, 0.0), MAX_PAUSE_S)
            self._clock.resume(scan.time, scan.stamp, received=time.monotonic() - pause_s)
            self._continuity.resume(scan.pose, scan.time, known=motion_is_known)
            self._is_by_scans = scan.by_scans
            self._mounting.resume(self.detector.finder.mountings[-1])
            self._report("recall", f"the map continues after {len(self)} scans and {len(loops)} loops")
        return [self._loop_edge(loop, time.monotonic()) for loop in self._rewrite_loops(loops)]

    def _written_loops(self) -> list[LoopClosure]:
        """Return the loops of the file, or none if there is no file: in a new folder, and after it was removed."""
        return read_loops_jsonl(self._loops_path, skip_damaged=True) if self._loops_path.is_file() else []

    def _rewrite_loops(self, loops: list[LoopClosure]) -> list[LoopClosure]:
        """Write the loops to a new file, unless the old one has the same content, and open it for appending. Returns
        loops that the old file lacks."""
        path = self._loops_path
        written = self._written_loops()
        missed = _missing(loops, written)
        if missed and written:
            self._report("log", f"{path}: {len(missed)} loops were added that the last process missed")
        content = loop_lines(loops).encode()
        if not path.is_file() or path.read_bytes() != content:  # with an equal file, a full disk does not matter
            write_bytes(path, content)
        with raising_write_error(path):
            self._loops_file = os.open(path, os.O_WRONLY | os.O_APPEND)
        return missed

    def add(self, frame: LiveFrame) -> list[LoopEdge] | None:
        """Add a scan and return its loops, or None if the scan is left out, which is reported. Raises ValueError if the
        scan or its odometry is invalid."""
        scan, pose = frame.scan, as_pose(frame.odometry)
        if scan.points is None or not np.isfinite(scan.points).all(axis=1).any():
            raise ValueError(f"{scan.name or 'scan'}: expected points, found none")
        if scan.mounting is None:
            scan = dataclasses.replace(scan, mounting=self._mounting.add(scan.points))
        finder = self.detector.finder
        scan_time = self._clock.time(frame.time, frame.received, is_recorded=frame.is_recorded)
        state = self._continuity.add(pose, scan_time)
        if state is None:
            return None
        keyframe = None
        if self._continuity.has_odometry and (state.pose is None or self._is_by_scans):
            keyframe = finder.keyframe(scan)
            state = self._state_by_scans(state, keyframe, scan_time)
            if state is None:
                return None
        is_keyframe = finder.is_due(time=scan_time, odometry=state.pose, continues=state.continues)
        if not is_keyframe:
            keyframe = None
        elif keyframe is None:
            keyframe = finder.keyframe(scan)
        described = LiveScan(
            keyframe=keyframe,
            is_keyframe=is_keyframe,
            compared=None,
            pose=state.pose,
            by_scans=self._is_by_scans,
            part=self._part if state.continues else self._part + 1,
            name=scan.name,
            stamp=float(frame.time) if np.isfinite(frame.time) else 0.0,
            time=scan_time,
            wall=time.time(),
        )
        loops = self._add(described)
        if is_keyframe and finder.empty[-1]:
            self._report("empty", f"{scan.name or f'scan {len(self) - 1}'}: expected a place, found almost no points")
        self._log_scan(described, finder.fits if is_keyframe else NO_FITS, loops)
        return [self._loop_edge(loop, frame.received) for loop in loops]

    def _state_by_scans(self, state: OdometryState, keyframe: Keyframe, time: float) -> OdometryState | None:
        """Return the state of a scan while odometry is missing, with the motion that the scans show. If they show
        none, the scan is left out (None) or has the last pose with unknown motion. The first odometry after that
        continues only if it agrees with the scans."""
        shown = self.detector.finder.pose_by_image(keyframe, time=time) if state.continues else None
        if state.pose is not None:
            self._is_by_scans, continues = False, shown is not None and agree(shown, state.pose)
            if state.continues and not continues:
                reason = "the scans did not show the motion" if shown is None else "it contradicts the scans"
                self._report("jump", f"the odometry is back and begins in a frame of its own: {reason}")
            return OdometryState(state.pose, continues)
        if shown is not None:
            self._is_by_scans = True
            return OdometryState(shown, True)
        found = "expected odometry or scans that show the motion, found none"
        if not len(self.odometry) or (state.may_be_left_out and not self._is_by_scans):
            return self._report("hold", f"{found}; the scan is left out")
        self._is_by_scans = True
        self._report("unknown", f"{found}; the scan is at an unknown place")
        return OdometryState(self.odometry[-1], False)

    def _add(self, scan: LiveScan) -> list[LoopClosure]:
        """Add a scan to the detector and the trajectory, and return the loops that it closes."""
        loops, finder = list[LoopClosure](), self.detector.finder
        if scan.is_keyframe:
            options = {"fits": scan.compared, "continues": scan.part == self._part}
            loops = self.detector.add_keyframe(scan.keyframe, time=scan.time, odometry=scan.pose, **options)
            self._forget_results()
        else:
            finder.skip()
        self._part = scan.part
        self._stamps.append(scan.stamp)
        if scan.name and scan.name not in self.names:
            self.names.add(scan.name)
            self._name_bytes += sys.getsizeof(scan.name)
        if scan.pose is not None:
            self._poses.append(scan.pose)
            if self.trajectory is not None:
                segments = finder.segments_of(np.arange(max(len(self) - 2, 0), len(self)))  # of this and the last scan
                ordered = sorted(loops, key=lambda loop: loop.query)
                self.trajectory.add(scan.pose, ordered, continues=bool(segments[0] == segments[-1]))
        return loops

    def _forget_results(self) -> None:
        """Remove results from memory: candidates, whose `fits` are in the log, and with `max_places` also old rejected
        pairs, and old loops, which are in their file."""
        self.detector.candidates.clear()
        most = self.detector.config.max_places
        if most is not None:
            del self.detector.rejected[:-most]
            if self._log is not None:
                del self.detector.loops[:-most]

    def _log_scan(self, scan: LiveScan, compared: Fits, loops: list[LoopClosure]) -> None:
        """Write a scan to the log and its loops to their file. After an error, the map continues in memory only."""
        if self._log is None:
            return
        side = "before"
        try:
            with raising_write_error(self._loops_path):
                status = os.fstat(self._loops_file)
                if not status.st_nlink:
                    raise FileNotFoundError("the file was removed")
            about = {name: getattr(scan, name) for name in ABOUT}
            self._log.append(len(self) - 1, frame_bytes(scan.keyframe, compared, pose=scan.pose, **about))
            side = "after"
            with raising_write_error(self._loops_path):
                append_whole(self._loops_file, loop_lines(loops).encode(), size=status.st_size)
            if time.monotonic() - self._synced_at > SYNC_S:
                self._log.sync()
                os.fsync(self._loops_file)
                self._synced_at = time.monotonic()
        except OSError as error:
            self._report("disk", f"{error}; the map is not written any more, and a restart continues {side} this scan")
            with contextlib.suppress(OSError):
                self._log.close()
            self._log = None

    def close(self) -> None:
        """Force everything to the disk and close the files."""
        if self._loops_file >= 0:
            os.close(self._loops_file)
        if self._log is not None:
            self._log.close()

    def _loop_edge(self, loop: LoopClosure, received: float) -> LoopEdge:
        """Return a loop with the times and the odometry of its scans. Odometry is given only for scans in the odometry
        frame of the latest scan. `received` is the time at which the latest scan arrived."""
        frames = np.array([loop.query, loop.match])
        *segments, latest = self.detector.finder.segments_of(np.append(frames, len(self) - 1))
        in_latest_frame = (np.array(segments) == latest) & (len(self.odometry) > 0)
        pairs = zip(frames, in_latest_frame, strict=True)
        query_pose, match_pose = (self.odometry[frame].copy() if known else None for frame, known in pairs)
        return LoopEdge(
            query=loop.query,
            match=loop.match,
            query_time=float(self.stamps[loop.query]),
            match_time=float(self.stamps[loop.match]),
            match_from_query=loop.match_from_query,
            covariance=loop.covariance,
            probability=loop.probability,
            world_from_query=query_pose,
            world_from_match=match_pose,
            latency_s=time.monotonic() - received,
            odometry_frame=int(latest),
        )


def _missing(loops: list[LoopClosure], written: list[LoopClosure]) -> list[LoopClosure]:
    """Return the loops of other pairs than those of `written`."""
    pairs = {(loop.query, loop.match) for loop in written}
    return [loop for loop in loops if (loop.query, loop.match) not in pairs]
