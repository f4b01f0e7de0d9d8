"""Matches poses to scans with other times: nearest pose, or interpolation."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int64

from sglpr_jax.data.times import check_unit

WIDEST_S = (1.0, 2.0)
"""Maximum time between two poses for interpolation, in seconds: the least and the greatest value (`widest_gap_s`)."""
JITTER = 1.5
"""Maximum time between two poses for interpolation, as a multiple of the median time between them."""
BEYOND_S = 0.1
"""Maximum time of a scan before the first pose or after the last one, in seconds."""


class Matched(NamedTuple):
    """Nearest poses of the scans."""

    kept: Bool[np.ndarray, " q"]
    """True for scans with a pose near enough in time."""
    rows: Int[np.ndarray, " k"]
    """Row of the nearest pose, for the scans with a pose."""

    def described(self, file: str, *, max_gap_s: float) -> str:
        """Return the name of the pose file, with the number of skipped scans if there are any."""
        left_out = len(self.kept) - int(self.kept.sum())
        said = f"{file} ({left_out} of {len(self.kept)} scans left out: no pose within {max_gap_s:g} s)"
        return said if left_out else file


def nearest_rows(stamps: Int64[np.ndarray, " n"], times: Int64[np.ndarray, " q"]) -> Int[np.ndarray, " q"]:
    """Return the row of the nearest of the ordered `stamps` for each of `times`. Ties go to the earlier one."""
    later = np.searchsorted(stamps, times).clip(0, len(stamps) - 1)
    earlier = (later - 1).clip(0)
    return np.where(np.abs(times - stamps[earlier]) <= np.abs(stamps[later] - times), earlier, later)


def match_times(
    stamps: Int64[np.ndarray, " n"],
    times: Int64[np.ndarray, " q"],
    *,
    tick_s: float,
    max_gap_s: float,
    poses: Path,
    scans: Path,
) -> Matched:
    """Find the nearest pose of each scan.

    Arguments:
      stamps: Times of the poses, in ticks.
      times: Times of the scans, in ticks.
      tick_s: Duration of a tick, in seconds.
      max_gap_s: Maximum time between a scan and its pose, in seconds.
      poses: Pose file, for messages.
      scans: Folder of the scans, for messages.

    Raises:
      ValueError: If no scan has a pose within `max_gap_s`, or the unit of times changes.
    """
    order = np.argsort(stamps, kind="stable")
    check_unit(stamps[order] * tick_s, source=poses)
    check_unit(times * tick_s, source=scans)
    rows = order[nearest_rows(stamps[order], times)]
    gaps_s = np.abs(stamps[rows] - times) * tick_s
    kept = gaps_s <= max_gap_s
    if not kept.any():
        raise ValueError(
            f"{poses}: expected poses within {max_gap_s:g} s of the scans in {scans}, found the nearest "
            f"{gaps_s.min():g} s away"
        )
    return Matched(kept, rows[kept])


class Interpolated(NamedTuple):
    """Interpolated positions of the scans."""

    kept: Bool[np.ndarray, " q"]
    """True for scans with poses near enough in time on both sides."""
    positions: Float[np.ndarray, "q 3"]
    """Positions in metres, valid where `kept` is true."""


def widest_gap_s(stamps: Float[np.ndarray, " n"]) -> float:
    """Maximum time between two poses for interpolation, in seconds. It follows from the rate of ordered `stamps`.

    It is 1.5 s for poses at 1 Hz, to allow for jitter, and from 1 s to 2 s for other rates.
    """
    steps = np.diff(stamps)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    return float(np.clip(JITTER * usual, *WIDEST_S))


def interpolate(
    stamps: Float[np.ndarray, " n"], positions: Float[np.ndarray, "n 3"], times: Float[np.ndarray, " q"]
) -> Interpolated:
    """Interpolate positions linearly at `times`. `stamps` and `times` are in seconds and in any order."""
    if len(stamps) < 2:
        return Interpolated(np.zeros(len(times), bool), np.zeros((len(times), 3)))
    order = np.argsort(stamps, kind="stable")
    stamps, positions = stamps[order], positions[order]
    later = np.searchsorted(stamps, times).clip(1, len(stamps) - 1)
    near = stamps[later] - stamps[later - 1] <= widest_gap_s(stamps)
    within = (times >= stamps[0] - BEYOND_S) & (times <= stamps[-1] + BEYOND_S)
    return Interpolated(near & within, np.stack([np.interp(times, stamps, axis) for axis in positions.T], axis=1))


def interpolate_turns(
    stamps: Float[np.ndarray, " n"], quaternions: Float[np.ndarray, "n 4"], times: Float[np.ndarray, " q"]
) -> Float[np.ndarray, "q 3 3"]:
    """Interpolate rotations at `times` with constant angular velocity. At least two `stamps` are required."""
    from scipy.spatial.transform import Rotation  # imported here because the import is slow

    order = np.argsort(stamps, kind="stable")
    stamps, quaternions = stamps[order], quaternions[order]
    later = np.searchsorted(stamps, times).clip(1, len(stamps) - 1)
    before, after = Rotation.from_quat(quaternions[later - 1]), Rotation.from_quat(quaternions[later])
    widths = stamps[later] - stamps[later - 1]
    shares = ((times - stamps[later - 1]) / np.where(widths > 0, widths, 1)).clip(0, 1)
    turned = before * Rotation.from_rotvec(shares[:, None] * (before.inv() * after).as_rotvec())
    return turned.as_matrix().reshape(-1, 3, 3)


def poses_of(positions: Float[np.ndarray, "n 3"], rotations: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 4 4"]:
    """Combine positions and rotations to poses."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, positions
    return poses


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
