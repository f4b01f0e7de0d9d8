"""A pose for each scan from a pose file: row by row, or at the time of the scan where the file has times of its own."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.data.formats.timed_poses import WIDEST_S, interpolate, interpolate_turns, poses_of

SAME_S = 0.001
"""Times that differ by less are the same, written by another program."""
LEAST_SHARE = 0.5
"""Of the scans must have poses about their times, for a file to be of this drive and clock."""


class ScanPoses(NamedTuple):
    """Which scans have a pose, and how they came by it."""

    kept: Bool[np.ndarray, " n"]
    poses: Float[np.ndarray, "k 4 4"]
    """Of the scans that are kept."""
    said: str
    """How the file's times were brought together with those of the scans, for a person; "" where they are the same."""


def poses_at_scans(
    source: str,
    poses: Float[np.ndarray, "m 4 4"],
    stamps: Float[np.ndarray, " m"] | None,
    times: Float[np.ndarray, " n"] | None,
    *,
    scans: int,
    of: str,
) -> ScanPoses:
    """The poses of a file, `source`, at the scans: those of its rows, unless there are more, fewer, or of other times.

    These are interpolated; scans more than 1 s between two poses, or before the first and after the last, are not kept.
    `stamps` and `times` (seconds) are those of the poses and of the scans, `of` says what a row is for: "scan of 08".
    Raises ValueError where most scans have no pose, and for more or fewer rows where nothing tells the times.
    """
    if len(poses) == scans and (said := _row_by_row(stamps, times)) is not None:
        return ScanPoses(np.ones(scans, bool), poses, said)
    if stamps is None or times is None:
        why = "the file has no times" if stamps is None else "the scans have no times"
        raise ValueError(f"{source}: {_expected(scans, of)}, found {len(poses)}, and {why} to interpolate at")
    kept, positions = interpolate(stamps, poses[:, :3, 3], times)
    if kept.mean() < LEAST_SHARE:
        raise ValueError(_other_clock(source, stamps, times, of))
    missing = len(kept) - int(kept.sum())
    left_out = f"; {missing} of {len(kept)} scans left out, which have no pose" if missing else ""
    said = f"interpolated at the times of the scans{left_out}"
    return ScanPoses(kept, poses_of(positions, _turned(poses, stamps, times))[kept], said)


def unturned(positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4 4"]:
    """Poses at these positions, not turned: for files of which positions are all that is used."""
    return poses_of(positions, np.tile(np.eye(3), (len(positions), 1, 1)))


def _row_by_row(stamps: Float[np.ndarray, " n"] | None, times: Float[np.ndarray, " n"] | None) -> str | None:
    """What is said of row i being scan i; None where the times speak against it.

    Some programs count rows for want of times, 0, 1, 2, ..., and some begin at 0: the steps are those of the scans.
    """
    if stamps is None or times is None or np.array_equal(stamps, np.arange(len(stamps))):
        return ""
    behind = times - stamps
    if np.abs(behind).max() <= SAME_S:
        return ""
    elsewhere = stamps[-1] < times[0] or times[-1] < stamps[0]
    if elsewhere and np.ptp(behind) <= SAME_S:
        return f"row by row: their steps are those of the scans, {behind.mean():.1f} s later"
    return None


def _turned(
    poses: Float[np.ndarray, "m 4 4"], stamps: Float[np.ndarray, " m"], times: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3 3"]:
    from scipy.spatial.transform import Rotation  # takes longer than all else that opens a folder of scans

    return interpolate_turns(stamps, Rotation.from_matrix(poses[:, :3, :3]).as_quat(), times)


def _expected(scans: int, of: str) -> str:
    return f"expected {scans} poses, one for each {of}"


def _other_clock(source: str, stamps: Float[np.ndarray, " m"], times: Float[np.ndarray, " n"], of: str) -> str:
    """What is said of poses whose times are not those of the scans."""
    found = f"found {len(stamps)} of {stamps[0]:.1f} to {stamps[-1]:.1f} s"
    by_row = "; if row i belongs to scan i all the same, write 12 numbers a line, without times"
    return (
        f"{source}: {_expected(len(times), of)}, at its time, or poses at most {WIDEST_S:g} s apart about the times of "
        f"these, {times[0]:.1f} to {times[-1]:.1f} s, {found}{by_row if len(stamps) == len(times) else ''}"
    )
