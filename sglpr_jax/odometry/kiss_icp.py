"""Odometry from the scans alone, by kiss-icp (extra `odometry`): one pose of the LiDAR for each scan."""

import dataclasses
import importlib
from collections import deque
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import Scale
from sglpr_jax.data.deskew import point_times_problem, poses_at, valid_point_times
from sglpr_jax.data.fingerprint import fingerprint
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scaled import scaled, scaled_poses
from sglpr_jax.data.scan import Scan, are_measured
from sglpr_jax.data.scan_stream import OnBadScan, check_readable, scan_stream
from sglpr_jax.data.times import usual_step
from sglpr_jax.extras import optional_module
from sglpr_jax.files import warn
from sglpr_jax.frame_log import FrameLog
from sglpr_jax.odometry.config import OdometryConfig
from sglpr_jax.se3 import inverse, transformed

MIN_POINTS = 100
"""Minimum number of points after downsampling. The pose of a scan with fewer is extrapolated."""
PREVIOUS = 3
"""Number of previous scans that a scan must overlap."""
MIN_OVERLAP = 0.55
"""Minimum share of points with a point of the previous scans within a voxel. Consecutive scans of simulated streets
have more, scans of other places mostly less."""


RESULT_NUMBERS = 16 + 3
"""Numbers of a scan in the log: its pose, the time of its last point relative to the scan in seconds, its number of
points (NaN if it is unreadable), and its overlap (`_FrontEnd.add`)."""
Cloud = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " m"]]
"""Points of a scan in metres, and the time of each point relative to the scan in seconds or an empty array."""


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
    """Compute odometry from the scans of a recording: poses of the LiDAR in the frame of the first scan.

    If scans and points have times, the motion within scans is removed, and each pose is that at the time of its scan.
    Scans that are unreadable or have few points get an extrapolated pose. Warnings name the first scan with few points,
    and the first one that does not overlap the previous ones.

    Arguments:
      recording: The scans, about 10 a second.
      config: Settings of kiss-icp.
      scale: Factor for all lengths, as in `find_loops`. With 4, the default range is 25 m and the voxels .25 m.
      kept_in: Checkpoint file of this recording and these settings, from which a stopped call resumes. It stays.
      on_bad_scan: Called with id and error of an unreadable scan.
      should_stop: If it returns True, only the poses of the scans so far are returned.
      on_progress: Called with the number of processed scans.

    Raises:
      ValueError: If the recording has ready-made images, or if no scan is readable or has enough points.
      ImportError: If kiss-icp is not installed.

    Example:
      odometry = scan_odometry(recording)
      found = find_loops(recording, params, odometry=odometry)
    """
    recording.require_scans("scans for odometry")
    check_installed()
    path = None if kept_in is None else Path(kept_in)
    with FrameLog(path, {} if path is None else _settings(recording, config, scale), restarts=True) as log:
        rows = range(log.end)
        logged = {row: np.frombuffer(record) for row in rows if (record := log.record(row)) is not None}
        if len(logged) < len(recording):
            options = {"on_bad_scan": on_bad_scan, "should_stop": should_stop, "on_progress": on_progress}
            results = _register_scans(recording, log, logged, _FrontEnd(config, _steps(recording)), scale, **options)
        else:
            results = np.array([logged[row] for row in range(len(recording))])
    last_point_s, points, overlap = results[:, 16:].T
    if len(results) == len(recording):
        _check_registration(recording, points, overlap)
    poses = scaled_poses(results[:, :16].reshape(-1, 4, 4), 1 / scale)
    return _poses_at_scan_times(poses, recording, last_point_s)


def _settings(recording: Recording, config: OdometryConfig, scale: Scale) -> dict[str, Any]:
    """Settings that determine the records. A log with other settings is not resumed."""
    scans = [recording.name, fingerprint(recording, contents="some")]
    versions = {"kiss-icp": version("kiss-icp"), "record length": RESULT_NUMBERS, "guess": "velocity"}
    return {"scans": scans, **versions, "scale": scale, **dataclasses.asdict(config)}


def _steps(recording: Recording) -> Float[np.ndarray, " n"]:
    """Time from the previous scan to each scan, in seconds, or 1 without increasing times.

    Times of a receiver may come in bursts, so a step is at least as long as the usual one.
    """
    times = recording.times
    if times is None or not (np.diff(times) > 0).all() or len(times) < 2:
        return np.ones(len(recording))
    return np.maximum(np.diff(times, prepend=times[0]), usual_step(times))


def _register_scans(
    recording: Recording,
    log: FrameLog,
    logged: dict[int, Float[np.ndarray, "19"]],
    front_end: "_FrontEnd",
    scale: Scale,
    **options: Any,
) -> Float[np.ndarray, "n 19"]:
    """Add all scans to kiss-icp, those of the log at their logged poses. Returns `RESULT_NUMBERS` of each scan.

    New results are appended to the log. The options are those of `scan_stream`.
    """
    is_timed = not point_times_problem(recording)
    results = list[np.ndarray]()
    for row, cloud in scan_stream(scaled(recording, scale), lambda _, scan: _cloud(scan, is_timed), **options):
        known = logged.get(row)
        known_pose = None if known is None else known[:16].reshape(4, 4)
        pose, points, overlap = front_end.add(row, cloud, known_pose=known_pose)
        if known is None:
            last_point_s, points = (0.0, np.nan) if cloud is None else (cloud[1].max(initial=0), points)
            known = np.append(pose, [last_point_s, points, overlap])
            log.append(row, known.tobytes())
        results.append(known)
    return np.array(results).reshape(-1, RESULT_NUMBERS)


def _cloud(scan: Scan, is_timed: bool) -> Cloud:
    """Points of a scan that are finite and not all zero, with their times if `is_timed`."""
    points = scan.points
    assert points is not None
    valid = are_measured(points)
    times = valid_point_times(scan) if is_timed else None
    return points[valid].astype(np.float64), np.zeros(0) if times is None else times[valid].astype(np.float64)


class _FrontEnd:
    """kiss-icp, to which scans are added one after the other."""

    def __init__(self, config: OdometryConfig, steps: Float[np.ndarray, " n"]):
        """Begin a recording. `steps` are the times from one scan to the next, in any unit if points have no times."""
        data = {"max_range": config.max_range_m, "min_range": config.min_range_m, "deskew": True}
        mapping = {"voxel_size": config.used_voxel_m}
        settings = importlib.import_module("kiss_icp.config").KISSConfig(data=data, mapping=mapping)
        self._icp, self._voxel_m = check_installed().KissICP(settings), config.used_voxel_m
        self._steps, self._last_step = steps, 1.0
        self._previous_clouds: deque[Float[np.ndarray, "n 3"]] = deque(maxlen=PREVIOUS)
        """Points of the previous scans in the frame of the first scan."""

    def add(
        self, row: int, cloud: Cloud | None, *, known_pose: Float[np.ndarray, "4 4"] | None = None
    ) -> tuple[Float[np.ndarray, "4 4"], int, float]:
        """Register the next scan, or add it at its known pose. Without a scan or with few points, extrapolate.

        These are the steps of kiss-icp's `register_frame`, which takes no known pose and assumes that all steps take
        as long as a sweep. Returns the pose, the number of points after downsampling, and the result of `_overlap`.
        """
        icp, step = self._icp, float(self._steps[row])
        guess = icp.last_pose @ self._motion_in(step)
        source, mapped = np.zeros((0, 3)), np.zeros((0, 3))
        if cloud is not None:
            sweep = float(np.ptp(cloud[1])) if cloud[1].size else 0.0
            source, mapped = icp.voxelize(icp.preprocessor.preprocess(*cloud, self._motion_in(sweep)))
        if len(source) < MIN_POINTS:
            icp.last_pose = guess
            return guess, len(source), 1.0
        pose = known_pose
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
        icp.last_delta, self._last_step = np.linalg.inv(icp.last_pose) @ pose, step
        icp.last_pose = pose
        return pose, len(source), self._overlap(source, mapped, pose)

    def _motion_in(self, time: float) -> Float[np.ndarray, "4 4"]:
        """Motion in this time at the velocity of the last step."""
        steps = np.array([0.0, self._last_step])
        return poses_at(np.array([time]), steps, np.stack([np.eye(4), self._icp.last_delta]))[0]

    def _overlap(self, source: np.ndarray, mapped: np.ndarray, pose: np.ndarray) -> float:
        """Share of `source` with a point of the previous scans within a voxel. 1 for the first scans.

        Adds `mapped`, the points for the map, to the previous scans. Both are in the LiDAR frame at `pose`.
        """
        from scipy.spatial import KDTree  # imported here because the import is slow

        previous_clouds = list(self._previous_clouds)
        self._previous_clouds.append(transformed(pose, mapped))
        if len(previous_clouds) < PREVIOUS:
            return 1.0
        tree = KDTree(np.concatenate(previous_clouds), balanced_tree=False)
        distances, _ = tree.query(transformed(pose, source), distance_upper_bound=self._voxel_m)
        return float(np.isfinite(distances).mean())


def _poses_at_scan_times(
    poses: Float[np.ndarray, "n 4 4"], recording: Recording, last_point_s: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 4 4"]:
    """Interpolate poses of kiss-icp, which are those at the last point of each scan, to the times of the scans.

    `last_point_s` is the time of the last point relative to its scan, or 0. Without times, the poses stay.
    """
    delay_s = float(np.median(last_point_s[last_point_s != 0])) if last_point_s.any() else 0.0
    if delay_s == 0 or recording.times is None or len(poses) < 2:
        return poses
    times = recording.times[: len(poses)]
    interpolated = poses_at(times, times + delay_s, poses)
    return inverse(interpolated[0]) @ interpolated


def _check_registration(
    recording: Recording, points: Float[np.ndarray, " n"], overlap: Float[np.ndarray, " n"]
) -> None:
    """Warn of scans with few points or little overlap. Raises ValueError if no readable scan has enough points.

    `points` and `overlap` are those of `RESULT_NUMBERS`.
    """
    readable = int(np.isfinite(points).sum())
    check_readable(recording, readable)
    few = np.flatnonzero(points < MIN_POINTS)
    if len(few) == readable:
        raise ValueError(
            f"sequence {recording.name}: expected scans with {MIN_POINTS} points or more for odometry, found at most "
            f"{np.nanmax(points):.0f} after downsampling; use --scale 4 in rooms"
        )
    if len(few):
        warn(
            f"{recording.name}: expected {MIN_POINTS} points or more in each scan, found fewer in {len(few)}, first in "
            f"scan {recording.ids[few[0]]}; their odometry is extrapolated"
        )
    apart = np.flatnonzero(overlap < MIN_OVERLAP)
    if len(apart):
        warn(
            f"{recording.name}: expected scans that overlap the previous ones, found {len(apart)} that do not, first "
            f"scan {recording.ids[apart[0]]} ({overlap[apart[0]]:.0%}); the odometry may be wrong from there"
        )


def describe_odometry(recording: Recording, config: OdometryConfig, *, scale: Scale) -> str:
    """Describe the odometry of a recording to the user: kiss-icp's version, range and voxels in metres, deskewing."""
    problem = point_times_problem(recording)
    deskewing = f"motion within scans not removed: {problem}" if problem else "motion within scans removed"
    return (
        f"odometry: kiss-icp {version('kiss-icp')}, points up to {config.max_range_m / scale:g} m, voxels of "
        f"{config.used_voxel_m / scale:g} m, {deskewing}"
    )


def check_installed() -> ModuleType:
    """Import kiss-icp. Raises ImportError if it is not installed."""
    return optional_module("kiss_icp.kiss_icp", "odometry from scans", extra="odometry")
