"""Odometry from the scans alone, by kiss-icp (extra `odometry`): one pose of the LiDAR for each scan."""

import dataclasses
import importlib
from collections import deque
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.deskew import has_point_times, poses_at
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scaled import scaled, scaled_poses
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.scan_stream import OnBadScan, check_readable, scan_stream
from sglpr_jax.files import warn
from sglpr_jax.frame_log import RunLog
from sglpr_jax.odometry.config import OdometryConfig
from sglpr_jax.retrieval.descriptor_cache import fingerprint
from sglpr_jax.se3 import inverse, transformed

MIN_POINTS = 100
"""Minimum number of points after downsampling. The pose of a scan with fewer is extrapolated."""
PREVIOUS = 3
"""Number of previous scans that a scan must overlap."""
MIN_OVERLAP = 0.55
"""Minimum share of points with a point of the previous scans within a voxel. Consecutive scans of simulated streets
have more, scans of other places mostly less."""


Cloud = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " m"]]
"""Points of a scan in metres, and the time of each point relative to the scan in seconds or an empty array."""


class _Registered(NamedTuple):
    """Pose of a scan, and how well it was registered."""

    pose: Float[np.ndarray, "4 4"]
    points: int
    """Number of points after downsampling."""
    overlap: float
    """Share of points with a point of the previous scans within a voxel. 1 for the first scans."""


def scan_odometry(
    recording: Recording,
    *,
    config: OdometryConfig = OdometryConfig(),
    scale: Scale = 1,
    kept_in: Path | str | None = None,
    on_bad_scan: OnBadScan | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> Float[np.ndarray, "n 4 4"]:
    """Compute odometry from the scans of a recording, in the frame of the first scan. Fewer poses if stopped.

    If scans and points have times, the motion within scans is removed, and each pose is that at the time of its scan.
    Scans that are unreadable or have few points get an extrapolated pose. A warning names them, and scans that do not
    overlap the previous ones.

    Arguments:
      recording: The scans, about 10 a second.
      config: Settings of kiss-icp.
      scale: Factor for all lengths, as in `find_loops`. With 4, the default range is 25 m and the voxels .25 m.
      kept_in: Checkpoint file of this recording and these settings, from which a stopped call resumes. It stays.
      on_bad_scan: Called with id and error of an unreadable scan.
      should_stop: If it returns True, the poses of the scans so far are returned.
      on_progress: Called with the number of processed scans.

    Raises:
      ValueError: If the recording has ready-made images, or if no scan is readable or has enough points.
      ImportError: If kiss-icp is not installed.

    Example:
      odometry = scan_odometry(recording)
      found = find_loops(recording, params, odometry=odometry)
    """
    if recording.has_images:
        raise ValueError(f"sequence {recording.name}: expected scans for odometry, found ready-made images")
    check_installed()
    path, known = None if kept_in is None else Path(kept_in), np.zeros((0, 17))
    with RunLog(path, {} if path is None else _settings(recording, config, scale)) as log:
        if log.records:
            known = np.frombuffer(b"".join(log.records)).reshape(-1, 17)
        if len(known) < len(recording):
            options = {"on_bad_scan": on_bad_scan, "should_stop": should_stop, "on_progress": on_progress}
            known = _register(recording, log, known, _FrontEnd(config), scale, **options)
    poses = scaled_poses(known[:, :16].reshape(-1, 4, 4), 1 / scale)
    return _at_times_of_scans(poses, recording, known[:, 16])


def _settings(recording: Recording, config: OdometryConfig, scale: Scale) -> dict[str, Any]:
    """Settings that determine the poses."""
    scans = [recording.name, fingerprint(recording, contents="some")]
    return {"scans": scans, "kiss-icp": version("kiss-icp"), "scale": scale, **dataclasses.asdict(config)}


def _register(
    recording: Recording,
    log: RunLog,
    known: Float[np.ndarray, "k 17"],
    front_end: "_FrontEnd",
    scale: Scale,
    **options: Any,
) -> Float[np.ndarray, "n 17"]:
    """Pose of each scan and time of its last point. Adds new ones to the log, and warns of doubtful ones."""
    is_timed = has_point_times(recording)
    rows, registered = list(known), dict[int, _Registered]()
    for row, cloud in scan_stream(scaled(recording, scale), lambda _, scan: _cloud(scan, is_timed), **options):
        result = front_end.add(cloud, known=known[row, :16].reshape(4, 4) if row < len(known) else None)
        if cloud is not None:
            registered[row] = result
        if row >= len(known):
            rows.append(np.append(result.pose, 0.0 if cloud is None else cloud[1].max(initial=0)))
            log.append(row, rows[row].tobytes())
    if len(rows) == len(recording):
        check_readable(recording, len(registered))
        _warn_of_doubtful(recording, registered)
    return np.array(rows).reshape(-1, 17)


def _cloud(scan: Scan, is_timed: bool) -> Cloud:
    """Measured points of a scan, with their times if the scans have times."""
    points = scan.points
    assert points is not None
    valid = np.isfinite(points).all(axis=1) & (points != 0).any(axis=1)
    times = scan.point_times if is_timed else None
    return points[valid].astype(np.float64), np.zeros(0) if times is None else times[valid].astype(np.float64)


class _FrontEnd:
    """kiss-icp, one scan after the other."""

    def __init__(self, config: OdometryConfig):
        library, used = _library(), config.effective
        data = {"max_range": used.max_range_m, "min_range": used.min_range_m, "deskew": True}
        settings = importlib.import_module("kiss_icp.config").KISSConfig(
            data=data, mapping={"voxel_size": used.voxel_m}
        )
        self._icp, self._voxel_m = library.KissICP(settings), float(used.voxel_m or 0)
        self._previous: deque[Float[np.ndarray, "n 3"]] = deque(maxlen=PREVIOUS)

    def add(self, cloud: Cloud | None, *, known: Float[np.ndarray, "4 4"] | None = None) -> _Registered:
        """Register the next scan, or add it at its known pose. Without a scan, extrapolate the motion.

        These are the steps of kiss-icp's `register_frame`, which takes no known pose.
        """
        icp, guess = self._icp, self._icp.last_pose @ self._icp.last_delta
        source, mapped = np.zeros((0, 3)), np.zeros((0, 3))
        if cloud is not None:
            source, mapped = icp.voxelize(icp.preprocessor.preprocess(*cloud, icp.last_delta))
        if len(source) < MIN_POINTS:
            icp.last_pose = guess
            return _Registered(guess, len(source), 1.0)
        pose = known
        if pose is None:
            sigma = icp.adaptive_threshold.get_threshold()
            pose = icp.registration.align_points_to_map(
                points=source,
                voxel_map=icp.local_map,
                initial_guess=guess,
                max_correspondance_distance=3 * sigma,
                kernel=sigma,
            )
        icp.adaptive_threshold.update_model_deviation(np.linalg.inv(guess) @ pose)
        icp.local_map.update(mapped, pose)
        icp.last_delta, icp.last_pose = np.linalg.inv(icp.last_pose) @ pose, pose
        return _Registered(pose, len(source), self._overlap(source, mapped, pose))

    def _overlap(self, source: np.ndarray, mapped: np.ndarray, pose: np.ndarray) -> float:
        """Share of points with a point of the previous scans within a voxel."""
        from scipy.spatial import KDTree  # imported here because the import is slow

        previous = list(self._previous)
        self._previous.append(transformed(pose, mapped))
        if len(previous) < PREVIOUS:
            return 1.0
        tree = KDTree(np.concatenate(previous), balanced_tree=False)
        distances, _ = tree.query(transformed(pose, source), distance_upper_bound=self._voxel_m)
        return float(np.isfinite(distances).mean())


def _at_times_of_scans(
    poses: Float[np.ndarray, "n 4 4"], recording: Recording, ends: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 4 4"]:
    """Poses at the times of the scans. kiss-icp removes motion up to the last point, and its poses are those then."""
    end = float(np.median(ends[ends != 0])) if ends.any() else 0.0
    if end == 0 or recording.times is None or len(poses) < 2:
        return poses
    times = recording.times[: len(poses)]
    earlier = poses_at(times, times + end, poses)
    return inverse(earlier[0]) @ earlier


def _warn_of_doubtful(recording: Recording, registered: dict[int, _Registered]) -> None:
    """Warn of scans with few points and of scans without overlap. Raises ValueError if all scans have few points."""
    few = [row for row, result in registered.items() if result.points < MIN_POINTS]
    if len(few) == len(registered):
        raise ValueError(
            f"sequence {recording.name}: expected scans with {MIN_POINTS} points or more for odometry, found at most "
            f"{max(result.points for result in registered.values())} after downsampling; use --scale 4 in rooms"
        )
    if few:
        warn(
            f"{recording.name}: expected {MIN_POINTS} points or more in each scan, found fewer in {len(few)}, first in "
            f"scan {recording.ids[few[0]]}; their odometry is extrapolated"
        )
    apart = [row for row, result in registered.items() if result.overlap < MIN_OVERLAP]
    if apart:
        warn(
            f"{recording.name}: expected scans that overlap the previous ones, found {len(apart)} that do not, first "
            f"scan {recording.ids[apart[0]]} ({registered[apart[0]].overlap:.0%}); the odometry may be wrong from there"
        )


def about(recording: Recording, config: OdometryConfig, *, scale: Scale) -> str:
    """Describe how the odometry of a recording is computed, with lengths in its metres."""
    used = config.effective
    assert used.voxel_m is not None
    deskewing = "motion within scans removed" if has_point_times(recording) else "without times of points"
    return (
        f"odometry: kiss-icp {version('kiss-icp')}, points up to {used.max_range_m / scale:g} m, voxels of "
        f"{used.voxel_m / scale:g} m, {deskewing}"
    )


def check_installed() -> None:
    """Raises ImportError if kiss-icp is not installed."""
    _library()


def _library() -> ModuleType:
    try:
        return importlib.import_module("kiss_icp.kiss_icp")
    except ImportError as error:
        raise ImportError("odometry from scans needs kiss-icp: pip install 'sglpr-jax[odometry]'") from error
