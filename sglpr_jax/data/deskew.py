"""Removes the motion of the sensor within a scan, by the times of the points and a trajectory.

A scan takes about 0.1 s, and each point is relative to the pose of the sensor when the point was measured. `deskew`
moves the points of a scan into the frame of one pose. `deskewed` does so for a recording, with the poses of its scans.
"""

import contextlib
import dataclasses
import hashlib
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from sglpr_jax.data.poses import poses_of_scans
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan

TICK_S = 2e-5
"""Resolution of the times of points, in seconds. A point at 50 m moves by 3 mm in this time if the sensor turns by 180
degrees a second."""
WIDEST_S = 1.0
"""Maximum time between two scans with constant velocity between them, in seconds."""
DESKEWED = "deskewed"
"""Name of the read option that describes the trajectory of a deskewed recording."""
TRIED = 5
"""Number of scans in which times of points are searched, if the scans before are unreadable."""


def deskew(
    points: Float32[np.ndarray, "n 3"],
    point_times: Float[np.ndarray, " n"],
    *,
    time: float,
    pose_times: Float[np.ndarray, " m"],
    world_from_lidar: Float[np.ndarray, "m 4 4"],
) -> Float32[np.ndarray, "n 3"]:
    """Move the points of a scan to where the sensor sees them from its pose at the time of the scan.

    Arguments:
      points: Points in metres, each in the frame of the LiDAR when the point was measured. NaN stays NaN.
      point_times: Time of each point relative to `time`, in seconds.
      time: Time of the scan, in seconds.
      pose_times: Times of the poses in seconds, in increasing order.
      world_from_lidar: Poses of the LiDAR in a fixed frame. The velocity between two poses is constant.

    Raises ValueError if there are less than two poses or their times do not increase.

    Example:
      still = sglpr_jax.deskew(points, seconds, time=8.3, pose_times=np.array([8.3, 8.4]), world_from_lidar=poses)
    """
    if len(pose_times) < 2 or len(pose_times) != len(world_from_lidar) or not (np.diff(pose_times) > 0).all():
        raise ValueError(
            f"deskew: expected two poses or more at increasing times, found {len(world_from_lidar)} poses and "
            f"{len(pose_times)} times"
        )
    ticks = np.rint(np.asarray(point_times, np.float64) / TICK_S).astype(np.int64)
    first = int(ticks.min(initial=0))
    times = time + TICK_S * np.arange(first, int(ticks.max(initial=0)) + 1)
    poses = poses_at(np.append(times, time), pose_times, world_from_lidar)
    scan_from_lidar = np.linalg.solve(poses[-1], poses[:-1])[:, :3].astype(np.float32)[ticks - first]
    with np.errstate(invalid="ignore"):
        return np.einsum("nij,nj->ni", scan_from_lidar[:, :, :3], points) + scan_from_lidar[:, :, 3]


def poses_at(
    times: Float[np.ndarray, " q"], pose_times: Float[np.ndarray, " m"], poses: Float[np.ndarray, "m 4 4"]
) -> Float[np.ndarray, "q 4 4"]:
    """Interpolate poses at `times`, in seconds, with constant linear and angular velocity in the moving frame.

    Before the first and after the last pose, the velocity is that of the nearest two. `pose_times` must increase.
    """
    from scipy.spatial.transform import RigidTransform  # imported here because the import is slow

    segments, which = np.unique((np.searchsorted(pose_times, times) - 1).clip(0, len(poses) - 2), return_inverse=True)
    start_from_end = np.linalg.solve(poses[segments], poses[segments + 1])
    start_from_end[:, 3] = [0, 0, 0, 1]  # exactly, as `RigidTransform` requires
    motions = RigidTransform.from_matrix(start_from_end).as_exp_coords()
    fractions = (times - pose_times[segments[which]]) / (pose_times[segments + 1] - pose_times[segments])[which]
    moved = RigidTransform.from_exp_coords(fractions[:, None] * motions[which])
    return poses[segments[which]] @ moved.as_matrix()


def deskewed(recording: Recording, world_from_lidar: Float[np.ndarray, "n 4 4"]) -> Recording:
    """Return a recording whose scans are corrected when they are read: scan i is seen from pose i.

    A scan without a neighbour within a second is not changed.

    Arguments:
      recording: Recording of scans with times, whose points have times (`Scan.point_times`).
      world_from_lidar: Pose of the LiDAR at the time of each scan, from odometry or a map.

    Raises ValueError if scans or points have no times, or if the poses do not fit the scans.

    Example:
      recording = sglpr_jax.deskewed(recording, sglpr_jax.read_odometry("odometry.tum"))
    """
    poses, times = poses_of_scans(recording, world_from_lidar, use=DESKEWED), recording.times
    if times is None:
        raise ValueError(f"sequence {recording.name}: expected times of the scans to remove their motion, found none")
    first = _first_readable(recording)
    if first is not None and first.point_times is None:
        raise ValueError(
            f"sequence {recording.name}: expected times of the points to remove the motion within scans, found none"
        )

    def read(row: int, label_path: Path | None, lasers: bool) -> Scan:
        """Read a scan without the motion within it. Its points have no times any more."""
        scan = recording.read_row(row, label_path, lasers)
        point_times, rows = scan.point_times, _neighbours(times, row)
        if point_times is None:
            raise ValueError(f"{scan.name}: expected times of the points, found none")
        points = scan.cloud
        if len(rows) > 1:
            trajectory = {"pose_times": times[rows], "world_from_lidar": poses[rows]}
            points = deskew(points, point_times, time=float(times[row]), **trajectory)
        return dataclasses.replace(scan, points=points, time_field=None)

    isolated = sum(len(_neighbours(times, row)) < 2 for row in range(len(recording)))
    without = f", but {isolated} of {len(recording)} scans have no neighbour within {WIDEST_S:g} s" if isolated else ""
    digest = hashlib.sha256(times.tobytes() + poses.tobytes()).hexdigest()[:16]
    note = f"deskewed: the motion within each scan is removed by its poses{without}"
    return recording.derived(read, options={DESKEWED: digest}).noting(note)


def _neighbours(times: Float[np.ndarray, " n"], row: int) -> list[int]:
    """The scan at `row` and the scans before and after it within `WIDEST_S`."""
    before, after = np.searchsorted(times, times[row], "left") - 1, np.searchsorted(times, times[row], "right")
    rows = [int(near) for near in (before, row, after) if 0 <= near < len(times)]
    return [near for near in rows if abs(times[near] - times[row]) <= WIDEST_S]


def has_point_times(recording: Recording) -> bool:
    """Whether scans have increasing times and the points of the first readable scan have valid times."""
    if recording.has_images or recording.times is None or not (np.diff(recording.times) > 0).all():
        return False
    scan = _first_readable(recording)
    try:
        return scan is not None and scan.point_times is not None
    except ValueError:
        return False


def _first_readable(recording: Recording) -> Scan | None:
    """The first scan that can be read, among the first `TRIED`."""
    for row in range(min(len(recording), TRIED)):
        with contextlib.suppress(ValueError, OSError):  # the program that reads the scans decides about bad ones
            return recording.scan(row, labels=False)
    return None
