"""Reads scans that are records of numbers without a header.

A `.bin` file does not define its record format. `record_size.py` detects it.
"""

from pathlib import Path
from typing import NamedTuple, TypeGuard, get_args

import numpy as np
from jaxtyping import Float32, Int32

from sglpr_jax.data.choices import RecordFormat
from sglpr_jax.data.formats.scan_size import check_points
from sglpr_jax.data.point_times import TimeField
from sglpr_jax.files import naming

NCLT_RECORD = np.dtype([("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")])
NCLT_UNIT_M = 0.005
NCLT_OFFSET_M = -100.0
"""Scale and offset of NCLT's integers: metres = value * unit + offset."""
Z_UP_FROM_Z_DOWN = np.array([1.0, -1.0, -1.0])
"""Rotation by 180 degrees about x: from forward, right, down to forward, left, up. Negating only z would mirror
scans."""


class Records(NamedTuple):
    """Points of one scan, with their lasers and times."""

    points: Float32[np.ndarray, "n 3"]
    """Points in metres: x forward, y left, z up if the format defines its axes, or else the axes of the file."""
    lasers: Int32[np.ndarray, " n"] | None
    """Laser number of each point, or None if the format has none."""
    times: TimeField | None = None
    """Field with the times of the points, or None if the format has none."""


def is_record(format: str) -> TypeGuard[RecordFormat]:
    """Whether scans of this format are records without a header."""
    return format in get_args(RecordFormat)


def record_type(format: RecordFormat) -> np.dtype:
    """Return the numpy type of one point. The field "xyz" comes first."""
    if format == "nclt":
        return NCLT_RECORD
    if format == "nuscenes":
        return np.dtype([("xyz", "<f4", 3), ("intensity", "<f4"), ("laser", "<f4")])
    number, columns = ("float32", "4") if format == "kitti" else format.split("x")
    letter = {"float32": "<f4", "float64": "<f8"}[number]
    more = int(columns) - 3
    return np.dtype([("xyz", letter, 3), *([("more", letter, more)] if more else [])])


def described(format: RecordFormat) -> str:
    """Return a description of a format: "float32x6 (24 bytes a point)"."""
    return f"{format} ({record_type(format).itemsize} bytes a point)"


def read_records(path: Path, format: RecordFormat, *, last_is_time: bool = False) -> Records:
    """Read a file of records.

    Arguments:
      path: The file.
      format: Format of one point.
      last_is_time: Whether the last of the columns after x, y, z is the time of the point.

    Raises:
      ValueError: If the file is empty or too large, or its size is not a multiple of the record size.

    Example:
      points = read_records(path, "float32x6").points
    """
    dtype = record_type(format)
    size = path.stat().st_size
    if size == 0 or size % dtype.itemsize:
        others = ", ".join(f"{name} has {record_type(name).itemsize}" for name in ("kitti", "nuscenes", "nclt"))
        raise ValueError(
            f"{path}: expected {dtype.itemsize} bytes for each point ({format}), found {size} bytes in total; the file"
            f" is truncated, or has another format ({others} bytes a point; pcd has a header)"
        )
    with naming(path):
        check_points(size // dtype.itemsize, bytes_each=dtype.itemsize)
    records = np.fromfile(path, dtype=dtype)
    times = TimeField("time", records["more"][:, -1].copy()) if last_is_time else None
    lasers = records["laser"].astype(np.int32) if "laser" in (dtype.names or ()) else None
    with np.errstate(over="ignore", invalid="ignore"):  # invalid numbers are dropped by the callers
        # Column-major order: the copy takes half the time, and later steps work along the axes.
        return Records(np.asfortranarray(_our_axes(records["xyz"], format), dtype=np.float32), lasers, times)


def _our_axes(xyz: np.ndarray, format: RecordFormat) -> np.ndarray:
    """Convert the coordinates of a format to metres, x forward, y left, z up."""
    if format == "nuscenes":
        return np.stack([xyz[:, 1], -xyz[:, 0], xyz[:, 2]], axis=1)
    if format == "nclt":
        return (xyz.astype(np.float64) * NCLT_UNIT_M + NCLT_OFFSET_M) * Z_UP_FROM_Z_DOWN
    return xyz
