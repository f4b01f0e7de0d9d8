"""Single-scan files: points from KITTI, nuScenes, NCLT and .pcd files, labels from SemanticKITTI's."""

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32, Int32

from sglpr_jax.data.formats.pcd import read_pcd

ScanFormat = Literal["auto", "kitti", "nuscenes", "nclt", "pcd"]

NCLT_RECORD = np.dtype([("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")])
NCLT_UNIT_M = 0.005
NCLT_OFFSET_M = -100.0
"""Metres = value * unit + offset."""
Z_UP_FROM_Z_DOWN = np.array([1.0, -1.0, -1.0])
"""Half a turn about x: from forward, right, down to forward, left, up. Negating z alone would mirror the scan."""

_RECORDS = {
    "kitti": np.dtype([("xyz", "<f4", 3), ("intensity", "<f4")]),
    "nuscenes": np.dtype([("xyz", "<f4", 3), ("intensity", "<f4"), ("ring", "<f4")]),
    "nclt": NCLT_RECORD,
}

_LASER_FIELDS = {"nuscenes": "ring", "nclt": "laser"}


def scan_id(path: Path) -> str:
    """Return the name of a scan file without its endings: "000052" for 000052.bin, "sweep" for sweep.pcd.bin."""
    return path.name.removesuffix(".bin").removesuffix(".pcd")


def guess_format(path: Path) -> ScanFormat:
    """Return the format that "auto" stands for.

    `*.pcd` is pcd, `*.pcd.bin` is nuscenes, a file in a folder `velodyne_sync` is nclt, any other is kitti. A .bin does
    not say what it holds: float32 x 5 under another name must be given as "nuscenes".
    """
    if path.name.endswith(".pcd"):
        return "pcd"
    if path.name.endswith(".pcd.bin"):
        return "nuscenes"
    return "nclt" if path.parent.name == "velodyne_sync" else "kitti"


def read_scan(path: Path | str, *, format: ScanFormat = "auto") -> Float32[np.ndarray, "n 3"]:
    """Return the points (n, 3) of one scan in metres: x forward, y left, z up. Intensities are dropped.

    - kitti: float32 x, y, z, intensity.
    - nuscenes: float32 x, y, z, intensity, ring. Its x points right and its y forward, so (x, y, z) becomes (y, -x, z).
    - nclt: uint16 x, y, z and two bytes; metres = value * 0.005 - 100, decoded in float64. Its y points right and its z
      down, so both are negated: a rotation, where negating z alone would mirror the scan.
    - pcd: see `read_pcd`; the axes stay as they are.

    Points that are not finite are kept, so that labels still fit; the rasteriser drops them. Raises FileNotFoundError,
    and ValueError where the file is empty or its size is no whole number of points.
    """
    return read_points_and_lasers(Path(path), format=format)[0]


def read_points_and_lasers(
    path: Path, *, format: ScanFormat = "auto"
) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, " n"] | None]:
    """Return what `read_scan` does and, from the same read, the number of the laser that each point is from.

    The numbers are those of the file (nuscenes, nclt), else None. Raises what `read_scan` raises.
    """
    format = guess_format(path) if format == "auto" else format
    if format == "pcd":
        return read_pcd(path), None
    records = _read_records(path, format)
    xyz = records["xyz"]
    if format == "nuscenes":
        xyz = np.stack([xyz[:, 1], -xyz[:, 0], xyz[:, 2]], axis=1)
    elif format == "nclt":
        xyz = (xyz.astype(np.float64) * NCLT_UNIT_M + NCLT_OFFSET_M) * Z_UP_FROM_Z_DOWN
    field = _LASER_FIELDS.get(format)
    lasers = None if field is None else records[field].astype(np.int32)
    return np.ascontiguousarray(xyz, dtype=np.float32), lasers


def _read_records(path: Path, format: str) -> np.ndarray:
    record = _RECORDS[format]
    size = _size(path)
    if size == 0 or size % record.itemsize:
        others = ", ".join(f"{name} has {r.itemsize}" for name, r in _RECORDS.items() if name != format)
        raise ValueError(
            f"{path}: expected {record.itemsize} bytes for each point ({format}), found {size} bytes in all; the file"
            f" is cut off, or has another format ({others} bytes a point; pcd has a header)"
        )
    return np.fromfile(path, dtype=record)


def read_labels(path: Path, *, points: int) -> Int32[np.ndarray, " n"]:
    """Return the raw SemanticKITTI ids (n,) of a .label file; the instance number in the upper 16 bits is dropped.

    Raises FileNotFoundError, and ValueError where the file has not 4 bytes for each of the scan's `points`.
    """
    size = _size(path)
    if size != 4 * points:
        raise ValueError(f"{path}: expected {points} labels of 4 bytes, one per point of its scan, found {size} bytes")
    return (np.fromfile(path, dtype="<u4") & 0xFFFF).astype(np.int32)


def _size(path: Path) -> int:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    return path.stat().st_size
