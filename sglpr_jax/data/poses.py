"""Poses of scans: checks, interpolation at the times of the scans, and poses that go row by row."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.times import usual_step
from sglpr_jax.se3 import are_rotations, quaternions

WIDEST_S = (1.0, 2.0)
"""Maximum time between two poses for interpolation, in seconds: the least and the greatest value (`widest_gap_s`)."""
JITTER = 1.5
"""Maximum time between two poses for interpolation, as a multiple of the median time between them."""
BEYOND_S = 0.1
"""Maximum time of a scan before the first pose or after the last one, in seconds."""
SAME_S = 0.001
"""Maximum difference of equal times, in seconds. Programs round times differently."""
LEAST_SHARE = 0.5
"""Minimum fraction of scans with a pose. Below it, the pose file belongs to another drive or clock."""


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
    """Return the poses that a caller gives for the scans of a recording, as float64.

    Arguments:
      recording: Recording of scans.
      world_from_lidar: Pose of the LiDAR at each scan.
      use: What the poses are used for, for messages.

    Raises:
      ValueError: If the recording has ready-made images, or if the poses have another length or no rotations.
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
    return float(np.clip(JITTER * usual_step(stamps), *WIDEST_S))


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
    stamps: Float[np.ndarray, " n"], turns: Float[np.ndarray, "n 4"], times: Float[np.ndarray, " q"]
) -> Float[np.ndarray, "q 3 3"]:
    """Interpolate rotations (quaternions x, y, z, w) at `times` with constant angular velocity.

    At least two `stamps` are required.
    """
    from scipy.spatial.transform import Rotation  # imported here because the import is slow

    order = np.argsort(stamps, kind="stable")
    stamps, turns = stamps[order], turns[order]
    later = np.searchsorted(stamps, times).clip(1, len(stamps) - 1)
    before, after = Rotation.from_quat(turns[later - 1]), Rotation.from_quat(turns[later])
    widths = stamps[later] - stamps[later - 1]
    shares = ((times - stamps[later - 1]) / np.where(widths > 0, widths, 1)).clip(0, 1)
    turned = before * Rotation.from_rotvec(shares[:, None] * (before.inv() * after).as_rotvec())
    return turned.as_matrix().reshape(-1, 3, 3)


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
    expected, found = f"expected {scans} poses, one for each {of}", f"found {len(poses)}"
    if stamps is None or times is None:
        why = "the file has no times" if stamps is None else "the scans have no times"
        raise ValueError(
            f"{source}: {expected}, {found}, and {why} to interpolate at (row numbers 0, 1, 2, ... are not times)"
        )
    kept, positions = interpolate(stamps, poses[:, :3, 3], times)
    if kept.mean() < LEAST_SHARE:
        by_row = "; if row i belongs to scan i nevertheless, write 12 numbers a line, without times"
        raise ValueError(
            f"{source}: {expected}, at its time, or poses at most {widest_gap_s(stamps):.2g} s apart that cover the "
            f"scans, {times[0]:.1f} to {times[-1]:.1f} s, {found} from {stamps[0]:.1f} to {stamps[-1]:.1f} s"
            f"{by_row if len(stamps) == len(times) else ''}"
        )
    missing = len(kept) - int(kept.sum())
    left_out = f"; {missing} of {len(kept)} scans left out, which have no pose" if missing else ""
    said = f"interpolated at the times of the scans{left_out}"
    rotations = interpolate_turns(stamps, quaternions(poses), times)
    return ScanPoses(kept, poses_of(positions, rotations)[kept], said)


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
