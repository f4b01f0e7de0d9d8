"""Poses that were measured at other times than the scans: for each scan the nearest one in time."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int, Int64


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
