"""Single-scan files: points of every format that is known, labels from SemanticKITTI's."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32

from sglpr_jax.data.choices import RecordFormat, ScanFormat
from sglpr_jax.data.formats.arrays import read_npy, read_npz
from sglpr_jax.data.formats.bin_records import is_record, read_records
from sglpr_jax.data.formats.las import read_las
from sglpr_jax.data.formats.pcd import read_pcd
from sglpr_jax.data.formats.ply import read_ply
from sglpr_jax.fields import check_value

READERS: dict[ScanFormat, Callable[[Path], Float32[np.ndarray, "n 3"]]] = {
    "pcd": read_pcd,
    "ply": read_ply,
    "npy": read_npy,
    "npz": read_npz,
    "las": read_las,
}
"""The formats with a header; each is the ending of its files too."""
ENDINGS = (".bin", ".pcd", ".ply")
"""Of files that are scans."""
ARRAY_ENDINGS = (".npy", ".npz", ".las")
"""Of files that are scans where none of the others lie beside them: else they are descriptors, poses or a map."""


def scan_id(path: Path) -> str:
    """Return the name of a scan file without its endings: "000052" for 000052.bin, "sweep" for sweep.pcd.bin."""
    name = path.stem if path.suffix.lower() == ".bin" else path.name
    return Path(name).stem if Path(name).suffix.lower()[1:] in READERS else name


def guess_format(path: Path, *, records: RecordFormat = "kitti") -> ScanFormat:
    """Return the format that "auto" stands for.

    Files with a header go by their ending, `*.pcd.bin` is nuscenes, a file in a folder `velodyne_sync` is nclt. Any
    other .bin does not say what it holds: it is `records`.
    """
    for format in READERS:
        if path.suffix.lower() == f".{format}":
            return format
    if path.name.lower().endswith(".pcd.bin"):
        return "nuscenes"
    return "nclt" if path.parent.name == "velodyne_sync" else records


def says_its_format(path: Path) -> bool:
    """Whether the name of a scan file tells what it holds."""
    return guess_format(path) != "kitti"


def read_scan(path: Path | str, *, format: ScanFormat = "auto") -> Float32[np.ndarray, "n 3"]:
    """Return the points (n, 3) of one scan in metres: x forward, y left, z up. Intensities are dropped.

    - kitti: float32 x, y, z, intensity.
    - nuscenes: float32 x, y, z, intensity, ring. Its x points right and its y forward, so (x, y, z) becomes (y, -x, z).
    - nclt: uint16 x, y, z and two bytes; metres = value * 0.005 - 100, decoded in float64. Its y points right and its z
      down, so both are negated: a rotation, where negating z alone would mirror the scan.
    - float32x5, float64x3 and so on: so many numbers a point, x, y and z first; the axes stay as they are.
    - pcd, ply, npy, npz, las: see their readers; the axes stay as they are.

    "auto" goes by the name, and takes a .bin that says nothing for kitti; `find_record` looks into the files. Points
    that are not finite are kept, so that labels still fit; the rasteriser drops them. Raises FileNotFoundError, and
    ValueError for another format, and where the file is empty or its size is no whole number of points.
    """
    return read_points_and_lasers(Path(path), format=format)[0]


def read_points_and_lasers(
    path: Path, *, format: ScanFormat = "auto", records: RecordFormat = "kitti"
) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, " n"] | None]:
    """Return what `read_scan` does and, from the same read, the number of the laser that each point is from.

    The numbers are those of the file (nuscenes, nclt), else None. `records` is what "auto" takes a .bin for that says
    nothing. Raises what `read_scan` raises.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    check_value(format, ScanFormat, f"{path}, format")
    known = guess_format(path, records=records) if format == "auto" else format
    if is_record(known):
        return read_records(path, known)
    return READERS[known](path), None


def read_labels(path: Path, *, points: int) -> Int32[np.ndarray, " n"]:
    """Return the raw SemanticKITTI ids (n,) of a .label file; the instance number in the upper 16 bits is dropped.

    Raises FileNotFoundError, and ValueError where the file has not 4 bytes for each of the scan's `points`.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    size = path.stat().st_size
    if size != 4 * points:
        raise ValueError(f"{path}: expected {points} labels of 4 bytes, one per point of its scan, found {size} bytes")
    return (np.fromfile(path, dtype="<u4") & 0xFFFF).astype(np.int32)
