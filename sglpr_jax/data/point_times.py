"""Times of the points of a scan: drivers write them in several units, relative to the scan or to an epoch.

A field of times does not state its unit. A scan takes 2 ms to 1 s, so the span of the values has one possible unit.
"""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Shaped

FIELDS = ("t", "time", "timestamp", "timestamps", "time_stamp", "stamps", "offset_time", "ts", "gps_time")
"""Names of the field that drivers use for the time of a point."""
UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)
"""Possible units, in seconds."""
SHORTEST_S, LONGEST_S = 0.002, 1.0
"""Range of the duration of a scan, in seconds. It is narrower than the ratio of two units."""
ABSOLUTE_S = 10.0
"""Minimum time of a point since an epoch, in seconds. Smaller times are relative to the scan."""
SAME_CLOCK_S = 1.0
"""Maximum time between a scan and its points, in seconds, if both have the same clock."""


class TimeField(NamedTuple):
    """Times of the points of a scan, as a file or message states them."""

    name: str
    """Name of the field."""
    values: Shaped[np.ndarray, " n"]
    """Numbers of the field, one per point, in an unknown unit."""

    def seconds(self, *, valid: Bool[np.ndarray, " n"], scan_time: float | None) -> Float32[np.ndarray, " n"]:
        """Return the time of each point relative to the time of its scan, in seconds.

        Relative times stay relative to the scan's time. Times since an epoch are compared with the scan's time. If
        that has another clock or is unknown, the first point has the time of the scan.

        Arguments:
          valid: True for points that were measured. The other points may have any time, and get 0.
          scan_time: Time of the scan in seconds, or None.

        Raises:
          ValueError: If the span of the times is not that of a scan in any unit.
        """
        values = np.where(valid & np.isfinite(self.values), self.values, np.nan).astype(np.float64)
        if np.isnan(values).all():
            raise ValueError(f"expected times of points in the field {self.name}, found no finite ones")
        first, last = np.nanmin(values), np.nanmax(values)
        unit_s = next((unit for unit in UNITS_S if SHORTEST_S <= (last - first) * unit <= LONGEST_S), None)
        if unit_s is None:
            raise ValueError(
                f"expected times of points over {SHORTEST_S:g} to {LONGEST_S:g} s in the field {self.name}, found "
                f"{first:.10g} to {last:.10g}, which no unit from s to ns makes so"
            )
        return np.nan_to_num(values * unit_s - _origin_s(first * unit_s, scan_time)).astype(np.float32)


def _origin_s(first_s: float, scan_time: float | None) -> float:
    """Time of the scan on the clock of its points, which begin at `first_s`."""
    if abs(first_s) < ABSOLUTE_S:
        return 0.0
    return first_s if scan_time is None or abs(first_s - scan_time) > SAME_CLOCK_S else scan_time


def time_field_of(names: Collection[str]) -> str | None:
    """Return the name of the field of times among the fields of a point, or None."""
    return next((name for name in FIELDS if name in names), None)
