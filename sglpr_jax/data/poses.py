"""Poses of scans: checks, and interpolation of poses at the times of the scans."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import as_array
from sglpr_jax.data.times import usual_step
from sglpr_jax.files import naming
from sglpr_jax.se3 import ROTATION_TOLERANCE, are_rotations, poses_of

GAP_RANGE_S = (1.0, 2.0)
"""Range of the maximum time between two poses for interpolation (`widest_gap_s`), in seconds."""
GAP_STEPS = 1.5
"""Maximum time between two poses for interpolation, as a multiple of the median time between them."""
BEYOND_S = 0.1
"""Maximum time of a scan before the first pose or after the last one, in seconds."""
SAME_S = 0.001
"""Maximum difference of equal times, in seconds. Programs round times differently."""
LEAST_SHARE = 0.5
"""Minimum fraction of scans with a pose. Below it, the poses are of another drive or clock, or no trajectory."""


def as_pose(odometry: Any) -> Float[np.ndarray, "4 4"] | None:
    """Convert a pose to a 4 x 4 array. Returns None for None."""
    return None if odometry is None else _checked_poses(odometry, "odometry (4, 4)", 2)


def as_poses(poses: Any, *, of: str) -> Float[np.ndarray, "n 4 4"]:
    """Convert an array or a list of 4 x 4 arrays to poses. Errors name them by `of`, for instance "odometry"."""
    return _checked_poses(poses, f"{of} (n, 4, 4)", 3)


def as_scan_poses(poses: Any, recording: Recording, *, of: str) -> Float[np.ndarray, "n 4 4"]:
    """Convert to poses, one for each scan of a recording. Raises ValueError for another number of poses."""
    with naming(recording.name):
        converted = as_poses(poses, of=of)
        if len(converted) != len(recording):
            raise ValueError(f"expected {of} of {len(recording)} scans, found {of} of {len(converted)} scans")
    return converted


def _checked_poses(values: Any, expected: str, ndim: int) -> Float[np.ndarray, "*n 4 4"]:
    """Convert to an array of poses of `ndim` axes: finite matrices with a rotation and the last row 0 0 0 1."""
    poses = as_array(values, np.float64, expected, by="read_odometry")
    if poses.ndim != ndim or poses.shape[-2:] != (4, 4):
        raise ValueError(f"expected {expected}, found an array of shape {poses.shape}")
    matrices = poses.reshape(-1, 4, 4)
    valid = np.isfinite(matrices).all((-2, -1)) & are_rotations(matrices[:, :3, :3])
    valid &= np.abs(matrices[:, 3] - [0, 0, 0, 1]).max(-1) < ROTATION_TOLERANCE
    if not valid.all():
        row = int(valid.argmin())
        raise ValueError(f"expected {expected}, with rotations, found {matrices[row].tolist()} in row {row}")
    return poses


def widest_gap_s(stamps: Float[np.ndarray, " n"]) -> float:
    """Maximum time between two poses for interpolation, in seconds: 1.5 times their median step, from 1 s to 2 s."""
    return float(np.clip(GAP_STEPS * usual_step(stamps), *GAP_RANGE_S))


def have_poses(stamps: Float[np.ndarray, " n"], times: Float[np.ndarray, " q"]) -> Bool[np.ndarray, " q"]:
    """Whether a pose is known at each of `times`: one has this time, or those around it are near (`widest_gap_s`).

    `stamps` are the times of two or more poses in seconds, in any order. A time may be up to `BEYOND_S` before or after
    them.
    """
    stamps = np.unique(stamps)
    if len(stamps) < 2:
        return np.zeros(len(times), bool)
    next_pose = np.searchsorted(stamps, times).clip(1, len(stamps) - 1)
    has_small_gap = stamps[next_pose] - stamps[next_pose - 1] <= widest_gap_s(stamps)
    return (has_small_gap | np.isin(times, stamps)) & (times >= stamps[0] - BEYOND_S) & (times <= stamps[-1] + BEYOND_S)


def interpolate_poses(
    stamps: Float[np.ndarray, " n"], poses: Float[np.ndarray, "n 4 4"], times: Float[np.ndarray, " q"]
) -> Float[np.ndarray, "q 4 4"]:
    """Interpolate positions linearly and rotations with constant angular velocity, at `times` in seconds.

    `stamps` are the times of the poses, in any order. The result is meaningful where `have_poses` is true.
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
    """Interpolate poses with times `stamps` at one time, in seconds, or return None if `have_poses` is false."""
    times = np.array([time])
    return interpolate_poses(stamps, poses, times)[0] if have_poses(stamps, times).all() else None


class ScanPoses(NamedTuple):
    """Poses of the scans of a recording."""

    has_pose: Bool[np.ndarray, " n"]
    """Whether each scan has a pose."""
    poses: Float[np.ndarray, "k 4 4"]
    """Poses of the scans that have one."""
    note: str
    """Description of how poses and scans were matched. Empty if their times are equal or unknown."""


def poses_at_scans(
    source: str,
    poses: Float[np.ndarray, "m 4 4"],
    stamps: Float[np.ndarray, " m"] | None,
    times: Float[np.ndarray, " n"] | None,
    *,
    scans: int,
    item: str,
) -> ScanPoses:
    """Assign poses to scans: pose i to scan i, or poses interpolated at the times of the scans (`have_poses`).

    Pose i belongs to scan i if there are as many poses as scans and their times are equal, unknown, or have the same
    intervals from another origin.

    Arguments:
      source: Name of the pose file, for messages.
      poses: Poses in the file.
      stamps: Times of the poses in seconds, or None.
      times: Times of the scans in seconds, or None.
      scans: Number of scans.
      item: Name of what each pose belongs to, for messages: "scan of 08".

    Raises ValueError if fewer than half of the scans have a pose, or if interpolation is needed and times are missing.
    """
    if len(poses) == scans and (note := _row_by_row_note(stamps, times)) is not None:
        return ScanPoses(np.ones(scans, bool), poses, note)
    expected, found = f"expected {scans} poses, one for each {item}", f"found {len(poses)}"
    if stamps is None or times is None:
        why = "the file has no times" if stamps is None else "the scans have no times"
        raise ValueError(
            f"{source}: {expected}, {found}, and {why} to interpolate at (row numbers 0, 1, 2, ... are not times)"
        )
    has_pose = have_poses(stamps, times)
    if has_pose.mean() < LEAST_SHARE:
        advice = "; if row i belongs to scan i nevertheless, write 12 numbers a line, without times"
        raise ValueError(
            f"{source}: {expected}, at its time, or poses at most {widest_gap_s(stamps):.2g} s apart that cover the "
            f"scans, {times[0]:.1f} to {times[-1]:.1f} s, {found} from {stamps[0]:.1f} to {stamps[-1]:.1f} s"
            f"{advice if len(stamps) == len(times) else ''}"
        )
    note = f"interpolated at the times of the scans{missing_poses_note(has_pose)}"
    return ScanPoses(has_pose, interpolate_poses(stamps, poses, times)[has_pose], note)


def missing_poses_note(has_pose: Bool[np.ndarray, " n"]) -> str:
    """Describe how many scans have no pose. The description is empty if all have one."""
    missing = len(has_pose) - int(has_pose.sum())
    return f"; {missing} of {len(has_pose)} scans left out, which have no pose" if missing else ""


def _row_by_row_note(stamps: Float[np.ndarray, " n"] | None, times: Float[np.ndarray, " n"] | None) -> str | None:
    """Describe how pose i fits scan i by their times, or return None if it does not. "" for equal or unknown times."""
    if stamps is None or times is None:
        return ""
    offsets = times - stamps
    if np.abs(offsets).max() <= SAME_S:
        return ""
    is_other_clock = stamps[-1] < times[0] or times[-1] < stamps[0]
    if is_other_clock and np.ptp(offsets) <= SAME_S:
        return f"row by row: the scans have the same intervals and start {offsets.mean():.1f} s later"
    return None
