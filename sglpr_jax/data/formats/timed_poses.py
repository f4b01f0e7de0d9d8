"""Poses that were measured at other times than the scans: for each scan the nearest one, or one between two."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int64

WIDEST_S = 1.0
"""Between poses farther apart in time nothing is interpolated."""
BEYOND_S = 0.1
"""A scan may come so much before the first pose, or after the last."""


class Matched(NamedTuple):
    """Which scans have a pose near enough in time, and which."""

    kept: Bool[np.ndarray, " q"]
    rows: Int[np.ndarray, " k"]
    """Of the scans that are kept."""

    def described(self, file: str, *, max_gap_s: float) -> str:
        """The pose file, and how many scans are left out."""
        left_out = len(self.kept) - int(self.kept.sum())
        said = f"{file} ({left_out} of {len(self.kept)} scans left out: no pose within {max_gap_s:g} s)"
        return said if left_out else file


def nearest_rows(stamps: Int64[np.ndarray, " n"], times: Int64[np.ndarray, " q"]) -> Int[np.ndarray, " q"]:
    """Return which of the ordered `stamps` is nearest to each of `times`, the earlier one of two equally near."""
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
    """Return the nearest of the poses' `stamps` for the scans' `times`, both in ticks of `tick_s` seconds.

    Raises ValueError, which names both files, where no scan has a pose within `max_gap_s` seconds.
    """
    order = np.argsort(stamps, kind="stable")
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
    """Where the scans were taken, by poses of other times."""

    kept: Bool[np.ndarray, " q"]
    """Which scans have poses near enough in time on both sides."""
    positions: Float[np.ndarray, "q 3"]
    """Metres; of the others they mean nothing."""


def interpolate(
    stamps: Float[np.ndarray, " n"], positions: Float[np.ndarray, "n 3"], times: Float[np.ndarray, " q"]
) -> Interpolated:
    """Return the positions at `times` on straight lines between those at `stamps`, all in seconds, in any order."""
    if len(stamps) < 2:
        return Interpolated(np.zeros(len(times), bool), np.zeros((len(times), 3)))
    order = np.argsort(stamps, kind="stable")
    stamps, positions = stamps[order], positions[order]
    later = np.searchsorted(stamps, times).clip(1, len(stamps) - 1)
    near = stamps[later] - stamps[later - 1] <= WIDEST_S
    within = (times >= stamps[0] - BEYOND_S) & (times <= stamps[-1] + BEYOND_S)
    return Interpolated(near & within, np.stack([np.interp(times, stamps, axis) for axis in positions.T], axis=1))


def interpolate_turns(
    stamps: Float[np.ndarray, " n"], quaternions: Float[np.ndarray, "n 4"], times: Float[np.ndarray, " q"]
) -> Float[np.ndarray, "q 3 3"]:
    """Return the rotations at `times`, turning evenly between those at `stamps`, of which there are two or more."""
    from scipy.spatial.transform import Rotation  # takes longer than all else that opens a folder of scans

    order = np.argsort(stamps, kind="stable")
    stamps, quaternions = stamps[order], quaternions[order]
    later = np.searchsorted(stamps, times).clip(1, len(stamps) - 1)
    before, after = Rotation.from_quat(quaternions[later - 1]), Rotation.from_quat(quaternions[later])
    widths = stamps[later] - stamps[later - 1]
    shares = ((times - stamps[later - 1]) / np.where(widths > 0, widths, 1)).clip(0, 1)
    turned = before * Rotation.from_rotvec(shares[:, None] * (before.inv() * after).as_rotvec())
    return turned.as_matrix().reshape(-1, 3, 3)


def poses_of(positions: Float[np.ndarray, "n 3"], rotations: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 4 4"]:
    """Positions and rotations as poses."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, positions
    return poses
