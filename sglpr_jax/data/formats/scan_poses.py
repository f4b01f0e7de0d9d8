"""Assigns a pose to each scan: row by row, or by interpolation if the pose file has its own times."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.data.formats.timed_poses import interpolate, interpolate_turns, poses_of, widest_gap_s

SAME_S = 0.001
"""Maximum difference of equal times, in seconds. Programs round times differently."""
LEAST_SHARE = 0.5
"""Minimum fraction of scans with a pose. Below it, the pose file belongs to another drive or clock."""


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
    """Assign a pose to each scan.

    If the numbers of poses and scans are equal and their times do not differ, poses are assigned row by row. This also
    applies to `stamps` with another origin but the same intervals. Otherwise the poses are interpolated. A scan has no
    pose if the poses before and after it are too far apart in time (`widest_gap_s`), or if it is more than 0.1 s before
    the first pose or after the last one.

    Arguments:
      source: Name of the pose file, for messages.
      poses: Poses in the file.
      stamps: Times of the poses in seconds, or None.
      times: Times of the scans in seconds, or None.
      scans: Number of scans.
      of: What a row belongs to, for messages: "scan of 08".

    Raises:
      ValueError: If fewer than half of the scans have a pose, or if interpolation is needed and times are missing.
    """
    if len(poses) == scans and (said := _row_by_row(stamps, times)) is not None:
        return ScanPoses(np.ones(scans, bool), poses, said)
    if stamps is None or times is None:
        why = "the file has no times" if stamps is None else "the scans have no times"
        raise ValueError(
            f"{source}: {_expected(scans, of)}, found {len(poses)}, and {why} to interpolate at (row numbers "
            "0, 1, 2, ... are not times)"
        )
    kept, positions = interpolate(stamps, poses[:, :3, 3], times)
    if kept.mean() < LEAST_SHARE:
        raise ValueError(_other_clock(source, stamps, times, of))
    missing = len(kept) - int(kept.sum())
    left_out = f"; {missing} of {len(kept)} scans left out, which have no pose" if missing else ""
    said = f"interpolated at the times of the scans{left_out}"
    return ScanPoses(kept, poses_of(positions, _turned(poses, stamps, times))[kept], said)


def unturned(positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4 4"]:
    """Poses at these positions with identity rotations, for files whose rotations are not used."""
    return poses_of(positions, np.tile(np.eye(3), (len(positions), 1, 1)))


def _row_by_row(stamps: Float[np.ndarray, " n"] | None, times: Float[np.ndarray, " n"] | None) -> str | None:
    """Description of a match row by row, or None if the times contradict it."""
    if stamps is None or times is None:
        return ""
    behind = times - stamps
    if np.abs(behind).max() <= SAME_S:
        return ""
    elsewhere = stamps[-1] < times[0] or times[-1] < stamps[0]
    if elsewhere and np.ptp(behind) <= SAME_S:
        return f"row by row: the scans have the same intervals and start {behind.mean():.1f} s later"
    return None


def _turned(
    poses: Float[np.ndarray, "m 4 4"], stamps: Float[np.ndarray, " m"], times: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3 3"]:
    from scipy.spatial.transform import Rotation  # imported here because the import is slow

    return interpolate_turns(stamps, Rotation.from_matrix(poses[:, :3, :3]).as_quat(), times)


def _expected(scans: int, of: str) -> str:
    return f"expected {scans} poses, one for each {of}"


def _other_clock(source: str, stamps: Float[np.ndarray, " m"], times: Float[np.ndarray, " n"], of: str) -> str:
    """Error message for poses whose times differ from those of the scans."""
    found = f"found {len(stamps)} from {stamps[0]:.1f} to {stamps[-1]:.1f} s"
    by_row = "; if row i belongs to scan i nevertheless, write 12 numbers a line, without times"
    return (
        f"{source}: {_expected(len(times), of)}, at its time, or poses at most {widest_gap_s(stamps):.2g} s apart that "
        f"cover the scans, {times[0]:.1f} to {times[-1]:.1f} s, {found}{by_row if len(stamps) == len(times) else ''}"
    )
