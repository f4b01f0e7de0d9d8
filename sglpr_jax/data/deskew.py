"""Removal of the motion of the sensor within a scan, with the times of the points and a trajectory.

A scan takes about 0.1 s, and each point is relative to the pose of the sensor when the point was measured. `deskew`
moves the points of a scan into the frame of one pose. `deskewed` does so for a recording, with the poses of its scans.
"""

import dataclasses
import hashlib
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from sglpr_jax.data.poses import as_scan_poses
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.files import warn

TICK_S = 2e-5
"""Resolution of the times of points, in seconds. In this time, a point at 50 m moves by 3 mm if the sensor turns by 180
degrees a second."""
WIDEST_S = 1.0
"""Maximum time between two scans with constant velocity between them, in seconds."""
MOST_APART_S = 10.0
"""Maximum time between a scan and its points, in seconds."""
DESKEWED = "deskewed"
"""Name of the read option that describes the trajectory of a deskewed recording."""
MOST_TRIED = 5
"""Maximum number of scans, from the first one, that are read to find a scan with valid times of its points."""


def deskew(
    points: Float32[np.ndarray, "n 3"],
    point_times: Float[np.ndarray, " n"],
    *,
    time: float,
    pose_times: Float[np.ndarray, " m"],
    world_from_lidar: Float[np.ndarray, "m 4 4"],
) -> Float32[np.ndarray, "n 3"]:
    """Transform the points of a scan to the frame of the LiDAR at the time of the scan.

    Arguments:
      points: Points in metres, each in the frame of the LiDAR at the time of the point. NaN stays NaN.
      point_times: Time of each point relative to `time`, in seconds.
      time: Time of the scan, in seconds.
      pose_times: Times of the poses in seconds, in increasing order.
      world_from_lidar: Poses of the LiDAR in a fixed frame. The velocity between two poses is constant.

    Raises ValueError if there are fewer than two poses, if their times do not increase, or if the times of the points
    are not finite, too far from 0 or not one per point.

    Example:
      points = sglpr_jax.deskew(points, seconds, time=8.3, pose_times=np.array([8.3, 8.4]), world_from_lidar=poses)
    """
    if len(pose_times) < 2 or len(pose_times) != len(world_from_lidar) or not (np.diff(pose_times) > 0).all():
        raise ValueError(
            f"deskew: expected two poses or more at increasing times, found {len(world_from_lidar)} poses and "
            f"{len(pose_times)} times"
        )
    seconds = np.asarray(point_times, np.float64)
    if len(seconds) != len(points) or not (np.abs(seconds) <= MOST_APART_S).all():  # also for NaN
        raise ValueError(
            f"deskew: expected for each point its time relative to the scan in seconds, within {MOST_APART_S:g}, found "
            f"{len(seconds)} times for {len(points)} points, up to {np.abs(seconds).max(initial=0):g}"
        )
    ticks = np.rint(seconds / TICK_S).astype(np.int64)
    first = int(ticks.min(initial=0))
    tick_times = time + TICK_S * np.arange(first, int(ticks.max(initial=0)) + 1)
    world_from_tick = poses_at(np.append(tick_times, time), pose_times, world_from_lidar)  # last: the scan's time
    scan_from_tick = np.linalg.solve(world_from_tick[-1], world_from_tick[:-1])[:, :3].astype(np.float32)
    scan_from_point = scan_from_tick[ticks - first]
    with np.errstate(invalid="ignore"):
        return np.einsum("nij,nj->ni", scan_from_point[:, :, :3], points) + scan_from_point[:, :, 3]


def poses_at(
    times: Float[np.ndarray, " q"], pose_times: Float[np.ndarray, " m"], poses: Float[np.ndarray, "m 4 4"]
) -> Float[np.ndarray, "q 4 4"]:
    """Interpolate poses at `times`, in seconds, with constant linear and angular velocity between two poses.

    Beyond the first or last pose, the velocity between the nearest two poses continues. `pose_times` must increase.
    """
    from scipy.spatial.transform import RigidTransform  # imported here because the import is slow

    previous = (np.searchsorted(pose_times, times) - 1).clip(0, len(poses) - 2)  # row of the pose before each time
    starts, segment = np.unique(previous, return_inverse=True)
    start_from_end = np.linalg.solve(poses[starts], poses[starts + 1])
    start_from_end[:, 3] = [0, 0, 0, 1]  # exactly, as `RigidTransform` requires
    motions = RigidTransform.from_matrix(start_from_end).as_exp_coords()
    fractions = (times - pose_times[previous]) / (pose_times[previous + 1] - pose_times[previous])
    start_from_lidar = RigidTransform.from_exp_coords(fractions[:, None] * motions[segment])
    return poses[previous] @ start_from_lidar.as_matrix()


def deskewed(recording: Recording, world_from_lidar: Float[np.ndarray, "n 4 4"]) -> Recording:
    """Return a recording whose scans are deskewed when they are read: the points of scan i are in the frame of pose i.

    A scan without another scan within a second before or after it, or without valid times of points, is not changed.

    Arguments:
      recording: Recording of scans with times, whose points have times (`Scan.point_times`).
      world_from_lidar: Pose of the LiDAR at the time of each scan, from odometry or a map.

    Raises ValueError if the scans have no times, none of the first scans is readable with valid times of points, or the
    poses do not fit the scans.

    Example:
      recording = sglpr_jax.deskewed(recording, sglpr_jax.read_odometry("odometry.tum"))
    """
    recording.require_scans("scans to deskew")
    poses, times = as_scan_poses(world_from_lidar, recording, of="poses"), recording.times
    if times is None:
        raise ValueError(f"sequence {recording.name}: expected times of the scans to remove their motion, found none")
    _check_point_times(recording)

    def read(row: int, label_path: Path | None) -> Scan:
        """Read and deskew a scan. The result has no times of points."""
        scan = recording.read_row(row, label_path)
        point_times = valid_point_times(scan)
        rows = _rows_near(times, row)
        points = scan.cloud
        if point_times is not None and len(rows) > 1:
            trajectory = {"pose_times": times[rows], "world_from_lidar": poses[rows]}
            points = deskew(points, point_times, time=float(times[row]), **trajectory)
        return dataclasses.replace(scan, points=points, time_field=None)

    isolated = sum(len(_rows_near(times, row)) < 2 for row in range(len(recording)))
    except_for = (
        f", but {isolated} of {len(recording)} scans have no neighbour within {WIDEST_S:g} s" if isolated else ""
    )
    digest = hashlib.sha256(times.tobytes() + poses.tobytes()).hexdigest()[:16]
    note = f"deskewed: the motion within each scan is removed by its poses{except_for}"
    return recording.with_reader(read, options={DESKEWED: digest}).with_note(note)


def _rows_near(times: Float[np.ndarray, " n"], row: int) -> list[int]:
    """Rows of the last scan before scan `row`, scan `row`, and the first scan after it, all within `WIDEST_S`."""
    before = int(np.searchsorted(times, times[row], "left")) - 1
    after = int(np.searchsorted(times, times[row], "right"))
    rows = [near for near in (before, row, after) if 0 <= near < len(times)]
    return [near for near in rows if abs(times[near] - times[row]) <= WIDEST_S]


def point_times_problem(recording: Recording) -> str:
    """Describe why the motion within the scans cannot be removed: "no valid times of points". Empty if it can be.

    Scans need increasing times, and the points of one of the first `MOST_TRIED` scans need valid times.
    """
    if recording.times is None:
        return "no times of scans"
    try:
        _check_point_times(recording)
    except (ValueError, OSError):
        return "no valid times of points"
    rows = np.flatnonzero(np.diff(recording.times) <= 0)
    return f"scan {recording.ids[rows[0] + 1]} is not later than the scan before it" if rows.size else ""


def valid_point_times(scan: Scan) -> Float32[np.ndarray, " n"] | None:
    """Return `Scan.point_times`. If they are invalid, as those of part of a turn, warns and returns None."""
    try:
        return scan.point_times
    except ValueError as error:
        warn(f"{error}; the motion within this scan is not removed")
        return None


def _check_point_times(recording: Recording) -> None:
    """Raise the first error of the first `MOST_TRIED` scans if none of them is readable with valid times of points."""
    first_error: Exception | None = None
    for row in range(min(len(recording), MOST_TRIED)):
        try:
            if recording.scan(row, labels=False).point_times is not None:
                return
        except (ValueError, OSError) as error:
            first_error = first_error or error
    raise first_error or ValueError(
        f"sequence {recording.name}: expected times of the points to remove the motion within scans, found none"
    )
