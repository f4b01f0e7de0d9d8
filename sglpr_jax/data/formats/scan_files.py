"""Reads single scans in all supported formats, point cloud maps in parts, and SemanticKITTI labels."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int32

from sglpr_jax.data.choices import RecordFormat, ScanFormat
from sglpr_jax.data.formats.arrays import read_points
from sglpr_jax.data.formats.bin_records import is_record, read_records, record_of_scan
from sglpr_jax.data.formats.clouds import Records
from sglpr_jax.data.formats.las import las_blocks, las_records
from sglpr_jax.data.formats.pcd import pcd_blocks, pcd_records
from sglpr_jax.data.formats.ply import ply_blocks, ply_records
from sglpr_jax.fields import check_value

READERS: dict[ScanFormat, Callable[[Path], Records]] = {
    "pcd": pcd_records,
    "ply": ply_records,
    "npy": lambda path: Records(read_points(path)),
    "npz": lambda path: Records(read_points(path)),
    "las": las_records,
}
"""Readers of formats with a header. The name of each format is also its file ending."""
BLOCKS: dict[str, Callable[[Path], Iterator[Float64[np.ndarray, "_ 3"]]]] = {
    ".pcd": pcd_blocks,
    ".ply": ply_blocks,
    ".las": las_blocks,
    ".laz": las_blocks,
}
"""Readers of point cloud maps in parts by file ending, so that a map may be larger than the memory."""
ENDINGS = (".bin", ".pcd", ".ply")
"""File endings of scans."""
ARRAY_ENDINGS = (".npy", ".npz", ".las")
"""File endings of scans in folders without files of `ENDINGS`. Beside them, they are descriptors, poses or a map."""


def scan_id(path: Path) -> str:
    """Return the name of a scan file without its endings: "000052" for 000052.bin, "sweep" for sweep.pcd.bin."""
    name = path.stem if path.suffix.lower() == ".bin" else path.name
    return Path(name).stem if Path(name).suffix.lower()[1:] in READERS else name


def named_format(path: Path) -> ScanFormat | None:
    """Return the format that the name of a scan file defines, or None: that of most .bin files is in their content.

    `*.pcd.bin` is nuscenes, and a file in a folder `velodyne_sync` is nclt.
    """
    for format in READERS:
        if path.suffix.lower() == f".{format}":
            return format
    if path.name.lower().endswith(".pcd.bin"):
        return "nuscenes"
    return "nclt" if path.parent.name == "velodyne_sync" else None


def found_format(path: Path) -> ScanFormat:
    """Return the format of one scan by its name or its content.

    Raises ValueError if the content fits no format, as for a folder of scans.
    """
    return named_format(path) or record_of_scan(path)


def read_scan(path: Path | str, *, format: ScanFormat = "auto") -> Float32[np.ndarray, "n 3"]:
    """Return the points (n, 3) of one scan in metres: x forward, y left, z up. Intensities are dropped.

    Points that are not finite are kept, so that labels still match. The rasteriser drops them.

    - kitti: float32 x, y, z, intensity.
    - nuscenes: float32 x, y, z, intensity, ring. Its x points right and its y forward, so (x, y, z) becomes (y, -x, z).
    - nclt: uint16 x, y, z and two bytes; metres = value * 0.005 - 100, decoded in float64. Its y points right and its z
      down, so both are negated. This is a rotation; negating only z would mirror the scan.
    - float32x5, float64x3 and so on: 5 or 3 numbers per point, beginning with x, y, z. The axes are not changed.
    - pcd, ply, npy, npz, las: see their readers. The axes are not changed.

    Arguments:
      path: File of the scan.
      format: Format of the scan. "auto" uses the name of the file. If the name does not define the format of a .bin
        file, the content does (`found_format`), as for a folder of scans.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the format is unknown, or the file is empty or malformed.
      ImportError: If the file is a .las file and the extra `las` is not installed.
    """
    path = Path(path)
    return read_scan_records(path, format=found_format(path) if format == "auto" else format).points


def read_scan_records(path: Path, *, format: ScanFormat = "auto", records: RecordFormat = "kitti") -> Records:
    """Return the points of a scan of a recording in metres, with their laser numbers and times.

    Raises what `read_scan` raises, except that `format` "auto" does not use the content.

    Arguments:
      path: File of the scan.
      format: Format of the scan.
      records: Format of .bin files whose name does not define it, for "auto".

    Returns:
      Points, laser numbers from the file (nuscenes, nclt) or None, and times from the file (pcd, ply, las) or None.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a scan, found none")
    check_value(format, ScanFormat, f"{path}, format")
    known = (named_format(path) or records) if format == "auto" else format
    if is_record(known):
        return read_records(path, known)
    return READERS[known](path)


def is_cloud_file(path: Path) -> bool:
    """Whether the path is a file with the ending of a point cloud map."""
    return path.suffix.lower() in BLOCKS and path.is_file()


def cloud_blocks(path: Path) -> Iterator[Float64[np.ndarray, "_ 3"]]:
    """Yield the points of a map in parts, in metres. Raises the errors of the readers."""
    return BLOCKS[path.suffix.lower()](path)


def read_labels(path: Path, *, points: int) -> Int32[np.ndarray, " n"]:
    """Return the raw SemanticKITTI ids (n,) of a .label file. The instance number in the upper 16 bits is dropped.

    Arguments:
      path: File of the labels.
      points: Number of points of the scan.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file does not have 4 bytes for each point.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected labels, found none")
    size = path.stat().st_size
    if size != 4 * points:
        raise ValueError(f"{path}: expected {points} labels of 4 bytes, one per point of its scan, found {size} bytes")
    return (np.fromfile(path, dtype="<u4") & 0xFFFF).astype(np.int32)
