"""Scans as records of numbers without a header: how many bytes each point has, and what its first three numbers are.

A `.bin` does not say what it holds; `record_size.py` finds it out.
"""

from pathlib import Path
from typing import NamedTuple, TypeGuard, get_args

import numpy as np
from jaxtyping import Float32, Int32

from sglpr_jax.data.choices import RecordFormat

NCLT_RECORD = np.dtype([("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")])
NCLT_UNIT_M = 0.005
NCLT_OFFSET_M = -100.0
"""Metres = value * unit + offset."""
Z_UP_FROM_Z_DOWN = np.array([1.0, -1.0, -1.0])
"""Half a turn about x: from forward, right, down to forward, left, up. Negating z alone would mirror the scan."""


class Records(NamedTuple):
    """What was read of one scan."""

    points: Float32[np.ndarray, "n 3"]
    """Metres: x forward, y left, z up, where the format says which axes it has."""
    lasers: Int32[np.ndarray, " n"] | None
    """The laser that each point is from, where the format says so."""


def is_record(format: str) -> TypeGuard[RecordFormat]:
    """Whether scans of a format are records without a header."""
    return format in get_args(RecordFormat)


def record_type(format: RecordFormat) -> np.dtype:
    """Return numpy's type of one point: "xyz", and what else there is."""
    if format == "nclt":
        return NCLT_RECORD
    if format == "nuscenes":
        return np.dtype([("xyz", "<f4", 3), ("intensity", "<f4"), ("laser", "<f4")])
    number, columns = ("float32", "4") if format == "kitti" else format.split("x")
    letter = {"float32": "<f4", "float64": "<f8"}[number]
    more = int(columns) - 3
    return np.dtype([("xyz", letter, 3), *([("more", letter, more)] if more else [])])


def described(format: RecordFormat) -> str:
    """Return a format in words: "float32x6 (24 bytes a point)"."""
    return f"{format} ({record_type(format).itemsize} bytes a point)"


def read_records(path: Path, format: RecordFormat) -> Records:
    """Return the points of a file of records, and their lasers. ValueError where its size is no whole number of them.

    Example:
      points = read_records(path, "float32x6").points
    """
    dtype = record_type(format)
    size = path.stat().st_size
    if size == 0 or size % dtype.itemsize:
        others = ", ".join(f"{name} has {record_type(name).itemsize}" for name in ("kitti", "nuscenes", "nclt"))
        raise ValueError(
            f"{path}: expected {dtype.itemsize} bytes for each point ({format}), found {size} bytes in all; the file"
            f" is cut off, or has another format ({others} bytes a point; pcd has a header)"
        )
    records = np.fromfile(path, dtype=dtype)
    lasers = records["laser"].astype(np.int32) if "laser" in (dtype.names or ()) else None
    with np.errstate(over="ignore", invalid="ignore"):  # numbers that are none: whoever uses the points drops them
        # One axis after the other in memory: copied in half the time, and whatever comes next goes along the axes.
        return Records(np.asfortranarray(_our_axes(records["xyz"], format), dtype=np.float32), lasers)


def _our_axes(xyz: np.ndarray, format: RecordFormat) -> np.ndarray:
    """Metres, x forward, y left, z up."""
    if format == "nuscenes":
        return np.stack([xyz[:, 1], -xyz[:, 0], xyz[:, 2]], axis=1)
    if format == "nclt":
        return (xyz.astype(np.float64) * NCLT_UNIT_M + NCLT_OFFSET_M) * Z_UP_FROM_Z_DOWN
    return xyz
