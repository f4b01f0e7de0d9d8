"""Poses of scans: checks, and interpolation of poses at the times of the scans."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.times import usual_step
from sglpr_jax.se3 import are_rotations

WIDEST_S = (1.0, 2.0)
"""Least and greatest value of the maximum time between two poses for interpolation (`widest_gap_s`), in seconds."""
JITTER = 1.5
"""Maximum time between two poses for interpolation, as a multiple of the median time between them."""
BEYOND_S = 0.1
"""Maximum time of a scan before the first pose or after the last one, in seconds."""
SAME_S = 0.001
"""Maximum difference of equal times, in seconds. Programs round times differently."""
LEAST_SHARE = 0.5
"""Minimum fraction of scans with a pose. Below it, the poses belong to another drive, another clock or a goal."""


def poses_of(
    positions: Float[np.ndarray, "n 3"], rotations: Float[np.ndarray, "n 3 3"] | None = None
) -> Float[np.ndarray, "n 4 4"]:
    """Combine positions and rotations to poses. The default is identity rotations."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    if rotations is not None:
        poses[:, :3, :3] = rotations
    return poses


def poses_of_scans(
    recording: Recording, world_from_lidar: Float[np.ndarray, "n 4 4"], *, use: str
) -> Float[np.ndarray, "n 4 4"]:
    """Return the poses that a caller gives for the scans of a recording, as float64. `use` names their use in messages.

    Raises ValueError for ready-made images, another number of poses, or poses without rotations.
    """
    if recording.has_images:
        raise ValueError(f"sequence {recording.name}: expected scans for {use}, found ready-made images")
    poses = np.asarray(world_from_lidar, np.float64)
    if poses.shape != (len(recording), 4, 4):
        raise ValueError(
            f"sequence {recording.name}: expected a pose (4, 4) for each of {len(recording)} scans, found an array of "
            f"shape {poses.shape}"
        )
    return turned_poses(poses, use=use)


def turned_poses(poses: Float[np.ndarray, "n 4 4"], *, use: str) -> Float[np.ndarray, "n 4 4"]:
    """Return the poses. Raises ValueError if one of them is not finite or has no rotation."""
    wrong = ~(np.isfinite(poses).all((-2, -1)) & are_rotations(poses[:, :3, :3]))
    if wrong.any():
        row = int(wrong.argmax())
        raise ValueError(f"{use}: expected poses with rotations, found {poses[row].tolist()} at scan {row}")
    return poses


def widest_gap_s(stamps: Float[np.ndarray, " n"]) -> float:
    """Maximum time between two poses for interpolation, in seconds: 1.5 s at 1 Hz, from 1 s to 2 s at other rates."""
    return float(np.clip(JITTER * usual_step(stamps), *WIDEST_S))


def have_poses(stamps: Float[np.ndarray, " n"], times: Float[np.ndarray, " q"]) -> Bool[np.ndarray, " q"]:
    """Whether each of `times` is between two poses that are near enough in time. `stamps` may have any order."""
    stamps = np.unique(stamps)
    if len(stamps) < 2:
        return np.zeros(len(times), bool)
    later = np.searchsorted(stamps, times).clip(1, len(stamps) - 1)
    near = stamps[later] - stamps[later - 1] <= widest_gap_s(stamps)
    return near & (times >= stamps[0] - BEYOND_S) & (times <= stamps[-1] + BEYOND_S)


def interpolate_poses(
    stamps: Float[np.ndarray, " n"], poses: Float[np.ndarray, "n 4 4"], times: Float[np.ndarray, " q"]
) -> Float[np.ndarray, "q 4 4"]:
    """Interpolate positions linearly and rotations with constant angular velocity. Valid where `have_poses` is true.

    `stamps` and `times` are in seconds and in any order.
    """
    from scipy.spatial.transform import Rotation, Slerp  # imported here because the import is slow

    stamps, rows = np.unique(stamps, return_index=True)
    if len(stamps) < 2:
        return poses_of(np.zeros((len(times), 3)))
    rotations = Slerp(stamps, Rotation.from_matrix(poses[rows, :3, :3]))(times.clip(stamps[0], stamps[-1]))
    positions = np.stack([np.interp(times, stamps, axis) for axis in poses[rows, :3, 3].T], axis=1)
    return poses_of(positions, rotations.as_matrix().reshape(-1, 3, 3))


def pose_at(
    stamps: Float[np.ndarray, " n"], poses: Float[np.ndarray, "n 4 4"], time: float
) -> Float[np.ndarray, "4 4"] | None:
    """Interpolate poses at one time, in seconds. Returns None if no poses are near enough in time (`have_poses`)."""
    times = np.array([time])
    return interpolate_poses(stamps, poses, times)[0] if have_poses(stamps, times).all() else None


class ScanPoses(NamedTuple):
    """Poses of the scans."""

    kept: Bool[np.ndarray, " n"]
    """True for scans with a pose."""
    poses: Float[np.ndarray, "k 4 4"]
    """Poses of the scans with a pose."""
    said: str
    """Description of how poses and scans were matched. Empty if their times are equal or unknown."""


def poses_at_scans(
    source: str,
    poses: Float[np.ndarray, "m 4 4"],
    stamps: Float[np.ndarray, " m"] | None,
    times: Float[np.ndarray, " n"] | None,
    *,
    scans: int,
    of: str,
) -> ScanPoses:
    """Assign poses to scans: pose i to scan i, or interpolated at the scans with poses near in time (`have_poses`).

    Pose i belongs to scan i if there are as many poses as scans and their times are equal, unknown, or have the same
    intervals from another origin.

    Arguments:
      source: Name of the pose file, for messages.
      poses: Poses in the file.
      stamps: Times of the poses in seconds, or None.
      times: Times of the scans in seconds, or None.
      scans: Number of scans.
      of: What a row belongs to, for messages: "scan of 08".

    Raises ValueError if fewer than half of the scans have a pose, or if interpolation is needed and times are missing.
    """
    if len(poses) == scans and (note := _row_by_row(stamps, times)) is not None:
        return ScanPoses(np.ones(scans, bool), poses, note)
    expected, found = f"expected {scans} poses, one for each {of}", f"found {len(poses)}"
    if stamps is None or times is None:
        why = "the file has no times" if stamps is None else "the scans have no times"
        raise ValueError(
            f"{source}: {expected}, {found}, and {why} to interpolate at (row numbers 0, 1, 2, ... are not times)"
        )
    with_pose = have_poses(stamps, times)
    if with_pose.mean() < LEAST_SHARE:
        by_row = "; if row i belongs to scan i nevertheless, write 12 numbers a line, without times"
        raise ValueError(
            f"{source}: {expected}, at its time, or poses at most {widest_gap_s(stamps):.2g} s apart that cover the "
            f"scans, {times[0]:.1f} to {times[-1]:.1f} s, {found} from {stamps[0]:.1f} to {stamps[-1]:.1f} s"
            f"{by_row if len(stamps) == len(times) else ''}"
        )
    note = f"interpolated at the times of the scans{left_out(with_pose)}"
    return ScanPoses(with_pose, interpolate_poses(stamps, poses, times)[with_pose], note)


def left_out(with_pose: Bool[np.ndarray, " n"]) -> str:
    """Describe how many scans have no pose. The description is empty if all have one."""
    missing = len(with_pose) - int(with_pose.sum())
    return f"; {missing} of {len(with_pose)} scans left out, which have no pose" if missing else ""


def _row_by_row(stamps: Float[np.ndarray, " n"] | None, times: Float[np.ndarray, " n"] | None) -> str | None:
    """Description of a match row by row, or None if the times contradict it."""
    if stamps is None or times is None:
        return ""
    offsets = times - stamps
    if np.abs(offsets).max() <= SAME_S:
        return ""
    other_clock = stamps[-1] < times[0] or times[-1] < stamps[0]
    if other_clock and np.ptp(offsets) <= SAME_S:
        return f"row by row: the scans have the same intervals and start {offsets.mean():.1f} s later"
    return None
