"""`Scan`: a scan or ready-made image, with the times of its points and the check of its points.

Drivers write times of points in several units, relative to the scan or to an epoch, without stating the unit. A scan
takes 2 ms to 1 s, so only one unit fits the span of its times.
"""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int, Int32, Shaped

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.fields import value_or_type
from sglpr_jax.files import in_short, naming
from sglpr_jax.labels import to_classes

MOST_COLUMNS = 8
"""Maximum number of columns of an array of points (x, y, z, intensity and further fields). Wider arrays are images."""
FARTHEST_M = 300.0
"""Limit of the largest coordinate of a point, in metres. No vehicle LiDAR has half of its points beyond it."""
TIME_FIELDS = ("t", "time", "timestamp", "timestamps", "time_stamp", "stamps", "offset_time", "ts", "gps_time")
"""Names of the field that drivers use for the time of a point."""
LASER_FIELDS = ("ring", "channel", "line", "laser_id", "laser")
"""Names of the field that drivers use for the laser number of a point."""
UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)
"""Possible units of the times of points, in seconds."""
SHORTEST_S, LONGEST_S = 0.002, 1.0
"""Range of the duration of a scan, in seconds. Their ratio is below 1000, so that only one unit fits. Times of points
beyond the longest duration are times since an epoch, and others are relative to the scan."""
SAME_CLOCK_S = 1.0
"""Maximum time between a scan and its points, in seconds, if both have the same clock."""


def check_cloud(points: Float32[np.ndarray, "n _"], *, name: str = "") -> None:
    """Raise ValueError, which begins with `name`, if a point cloud is unusable.

    The shape must be (n, 3), a finite point must differ from (0, 0, 0), and half of the finite points must be within
    `FARTHEST_M` in each axis.
    """
    source = f"{name}: " if name else ""
    if points.shape[1] != 3:
        raise ValueError(f"{source}expected points (n, 3) with x, y and z only, found shape {points.shape}")
    x, y, z = np.abs(points.T)  # Column by column: a reduction over the last axis takes ten times as long.
    largest = np.maximum(np.maximum(x, y), z)  # Not finite if any coordinate is not finite.
    is_near = largest <= FARTHEST_M
    if 2 * np.count_nonzero(is_near) > len(points) and (is_near & (largest > 0)).any():
        return  # Nearly all scans are valid and need no further test.
    largest = largest[np.isfinite(largest)]
    if not len(largest):
        raise ValueError(f"{source}expected finite points, found none among {len(points)}")
    if not largest.any():
        raise ValueError(f"{source}expected points around the sensor, found all {len(largest)} points at (0, 0, 0)")
    if 2 * np.count_nonzero(largest > FARTHEST_M) >= len(largest) and np.median(largest) > FARTHEST_M:
        raise ValueError(
            f"{source}expected metres, with most points within {FARTHEST_M:g}, found half of the points beyond"
            f" {np.median(largest):.4g} and the farthest at {largest.max():.4g}; are the coordinates in millimetres,"
            " or is the format of the scan wrong (--format, for .bin files)?"
        )


def are_measured(points: Float32[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Whether each point is finite and not (0, 0, 0), which drivers write for a ray without an echo."""
    return np.isfinite(points).all(axis=1) & (points != 0).any(axis=1)


class TimeField(NamedTuple):
    """Times of the points of a scan, as a file or message states them."""

    name: str
    """Name of the field."""
    values: Shaped[np.ndarray, " n"]
    """Values of the field, one per point, in an unknown unit."""

    def seconds(self, *, valid: Bool[np.ndarray, " n"], scan_time: float | None) -> Float32[np.ndarray, " n"]:
        """Return the time of each point relative to the time of its scan, in seconds.

        Times since an epoch are relative to `scan_time`, also since an epoch. If the scan has another clock or no time,
        they are relative to the first point. Points that are not `valid` may have any value, and get the time 0.

        Raises ValueError if no value is finite, or if the span of the values is not that of a scan in any unit.
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
        first_s = origin_s = first * unit_s
        if abs(first_s) <= LONGEST_S:
            origin_s = 0.0
        elif scan_time is not None and abs(first_s - scan_time) <= SAME_CLOCK_S:
            origin_s = scan_time
        return np.nan_to_num(values * unit_s - origin_s).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan (`points`) or one ready-made image (`image`). Missing or unrequested fields hold None."""

    points: Float32[np.ndarray, "n 3"] | None = None
    """Points in the LiDAR frame, in metres: x forward, y left, z up. Some may not be finite."""
    image: Float32[np.ndarray, "h w"] | None = None
    """Image in the orientation of equation 1 (`image[v, u]`, x to the right, y up), on the scale of counts."""
    labels: Int32[np.ndarray, "..."] | None = None
    """Raw SemanticKITTI ids, one per point or pixel. 0 means an unknown class."""
    labels_file: Path | None = None
    """File of the labels, for error messages."""
    lasers: Int32[np.ndarray, " n"] | None = None
    """Laser number of each point, if the file contains it."""
    name: str = ""
    """Name for error messages: "scan 000052 of sequence 08"."""
    time_field: TimeField | None = None
    """Times of the points as the file states them, or None if it has none."""
    time: float | None = None
    """Time of the scan in seconds, or None if unknown."""
    mounting: Mounting | None = None
    """Mounting of the sensor. None means gravity-aligned, 1.73 m above the ground."""

    @property
    def cloud(self) -> Float32[np.ndarray, "n 3"]:
        """Points of a scan, for type checkers: never None. Ready-made images have no points."""
        assert self.points is not None
        return self.points

    @property
    def upright_points(self) -> Float32[np.ndarray, "n 3"]:
        """Points in the frame of a gravity-aligned sensor 1.73 m above the ground. Models use these points."""
        return self.cloud if self.mounting is None else self.mounting.level(self.cloud)

    @property
    def point_times(self) -> Float32[np.ndarray, " n"] | None:
        """Time of each point relative to `time`, in seconds (`TimeField.seconds`), or None without times of points."""
        if self.time_field is None or self.points is None:
            return None
        with naming(self.name):
            return self.time_field.seconds(valid=are_measured(self.points), scan_time=self.time)

    def only(self, rows: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> "Scan":
        """Return the scan with only some points (rows or a mask), their labels and lasers, without times of points."""
        labels = None if self.labels is None else self.labels[rows]
        lasers = None if self.lasers is None else self.lasers[rows]
        return replace(self, points=self.cloud[rows], labels=labels, lasers=lasers, time_field=None)

    def classes(self, categories: int) -> Int32[np.ndarray, "..."] | None:
        """Return the class of every point or pixel in a setting with this many categories, or None without labels.

        Raises ValueError, with the file of the labels, if a label is no SemanticKITTI id.
        """
        if self.labels is None:
            return None
        with naming(self.labels_file or self.name):
            return to_classes(self.labels, categories=categories)


def as_scan(scan: Any) -> Scan:
    """Convert points (n, 3) or an image (h, w) to a `Scan`. A `Scan` is returned unchanged."""
    if isinstance(scan, Scan):
        return scan
    expected = "points (n, 3) or an image (h, w)"
    array = as_array(scan, np.float32, expected, by="read_scan")
    if array.ndim != 2:
        raise ValueError(f"expected {expected}, found an array of shape {array.shape}")
    if 3 < array.shape[1] <= MOST_COLUMNS:
        raise ValueError(f"expected points (n, 3) of x, y and z only, found an array of shape {array.shape}")
    return Scan(points=array) if array.shape[1] == 3 else Scan(image=array)


def as_array(values: Any, dtype: type, expected: str, *, by: str) -> np.ndarray:
    """Convert to an array of numbers, or raise TypeError. For a path, the message names its reader, `by`."""
    if isinstance(values, str | os.PathLike):
        raise TypeError(f"expected {expected}, found the path {values}; read it with sglpr_jax.{by}")
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError) as error:
        raise TypeError(f"expected {expected}, found {value_or_type(values)} ({in_short(error)})") from error
