"""Reads single scans in all supported formats, point cloud maps in parts, and SemanticKITTI labels."""

import contextlib
import dataclasses
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int32

from sglpr_jax.data.choices import RecordFormat, ScanFormat
from sglpr_jax.data.formats.bin_records import (
    detect_format_unless_kitti,
    is_headerless,
    read_records,
    warn_of_other_format,
)
from sglpr_jax.data.formats.clouds import MOST_POINTS, check_bytes, cloud_scan
from sglpr_jax.data.formats.las import las_blocks, las_scan
from sglpr_jax.data.formats.pcd_ply import (
    parse_pcd,
    parse_ply,
    posed_scan,
    table_blocks,
    table_scan,
    warn_of_viewpoint,
)
from sglpr_jax.data.scan import Scan
from sglpr_jax.fields import check_value
from sglpr_jax.files import in_short
from sglpr_jax.numpy_files import read_array

ARRAY_NAMES = ("points", "xyz", "pointcloud", "cloud", "scan")
"""Names of the array of points in an .npz file with several arrays. The first name that exists is used."""


def array_scan(path: Path) -> Scan:
    """Read the points of an .npy or .npz file: rows of numbers that begin with x, y, z, or records with such fields."""
    if path.suffix.lower() == ".npz":
        array = _read_npz(path)
    else:
        with path.open("rb") as stream:
            array = read_array(stream, size=path.stat().st_size)
    if {"x", "y", "z"} <= set(array.dtype.names or ()):
        array = np.stack([array[axis].reshape(-1) for axis in "xyz"], axis=1)
    is_numeric = array.dtype.kind in "fiu"
    if not is_numeric or array.ndim != 2 or not 3 <= array.shape[1] <= 32 or not 0 < len(array) <= MOST_POINTS:
        raise ValueError(f"expected points as rows of 3 to 32 numbers, found {array.dtype} of shape {array.shape}")
    return cloud_scan({"x": array[:, 0], "y": array[:, 1], "z": array[:, 2]})


def _read_npz(path: Path) -> np.ndarray:
    """Return the only array of an .npz file, or the first one that exists of `ARRAY_NAMES`."""
    with zipfile.ZipFile(path) as archive:
        files = [file for file in archive.infolist() if file.filename.endswith(".npy")]
        members = {file.filename.removesuffix(".npy"): file for file in files}
        names = list(members) if len(members) == 1 else [name for name in ARRAY_NAMES if name in members]
        if not names:
            expected, found = ", ".join(ARRAY_NAMES), ", ".join(members) or "none"
            raise ValueError(f"expected one array, or one named {expected}, found {found}")
        member = members[names[0]]
        check_bytes(member.file_size)
        with archive.open(member) as stream:
            return read_array(stream, size=member.file_size)


READERS: dict[ScanFormat, Callable[[Path], Scan]] = {
    "pcd": partial(table_scan, parse=parse_pcd),
    "pcd-viewpoint": posed_scan,
    "ply": partial(table_scan, parse=parse_ply),
    "npy": array_scan,
    "npz": array_scan,
    "las": las_scan,
}
"""Readers of formats with a header. The name of each format, up to a hyphen, is also its file ending."""
BLOCKS: dict[str, Callable[[Path], Iterator[Float64[np.ndarray, "_ 3"]]]] = {
    ".pcd": partial(table_blocks, parse=parse_pcd),
    ".ply": partial(table_blocks, parse=parse_ply),
    ".las": las_blocks,
    ".laz": las_blocks,
}
"""Readers of point cloud maps, by file ending. They yield blocks of points: a map may be larger than the memory."""
ENDINGS = (".bin", ".pcd", ".ply")
"""File endings of scans."""
ARRAY_ENDINGS = (".npy", ".npz", ".las")
"""File endings of scans in folders without `ENDINGS`. In other folders, such files are descriptors, poses or maps."""


def scan_names(names: Iterable[str]) -> list[str]:
    """Return the names in a folder that have one of `ENDINGS`, in any case, or else one of `ARRAY_ENDINGS`.

    Hidden files are skipped, as in `listing.files_in`.
    """
    visible = [name for name in names if not name.startswith(".")]
    scans = [name for name in visible if name.lower().endswith(ENDINGS)]
    return scans or [name for name in visible if name.lower().endswith(ARRAY_ENDINGS)]


def scan_id(path: Path) -> str:
    """Return the name of a scan file without its endings: "000052" for 000052.bin, "sweep" for sweep.pcd.bin."""
    name = path.stem if path.suffix.lower() == ".bin" else path.name
    return Path(name).stem if Path(name).suffix.lower()[1:] in READERS else name


def format_by_name(path: Path) -> ScanFormat | None:
    """Return the format of a scan by its name: the ending, `*.pcd.bin` (nuscenes) or the folder `velodyne_sync` (nclt).

    Returns None for other .bin files, whose names do not define the format.
    """
    if (ending := path.suffix.lower()[1:]) in READERS:
        return ending
    if path.name.lower().endswith(".pcd.bin"):
        return "nuscenes"
    return "nclt" if path.parent.name == "velodyne_sync" else None


def detect_format(path: Path) -> ScanFormat:
    """Return the format of one scan by its name, or else by its content (kitti if the content does not contradict).

    Warns of doubts about the content (`warn_of_doubts`).
    """
    by_name = format_by_name(path)
    if by_name is None:
        return detect_format_unless_kitti([path]) or "kitti"
    warn_of_doubts([path], by_name)
    return by_name


def warn_of_doubts(paths: Sequence[Path], format: ScanFormat) -> None:
    """Warn if scans do not look like scans of their format, or if the first one has a pose that is not applied."""
    if is_headerless(format):
        warn_of_other_format(paths, format)
    elif format == "pcd" and paths[0].is_file():
        warn_of_viewpoint(paths[0])


def read_scan(path: Path | str, *, format: ScanFormat = "auto") -> Float32[np.ndarray, "n 3"]:
    """Return the points (n, 3) of one scan in metres: x forward, y left, z up. Intensities are dropped.

    Points that are not finite are kept, so that labels still match.

    - kitti: float32 x, y, z, intensity.
    - nuscenes: float32 x, y, z, intensity, ring. Its x points right and its y forward, so (x, y, z) becomes (y, -x, z).
    - nclt: uint16 x, y, z and two bytes; metres = value * 0.005 - 100, decoded in float64. Its y points right and its z
      down, so both are negated. This is a rotation; negating only z would mirror the scan.
    - float32x5, float64x3 and so on: 5 or 3 numbers per point, beginning with x, y, z. The axes are not changed.
    - pcd, ply, npy, npz, las: see their readers. The axes are not changed.
    - pcd-viewpoint: as pcd, moved by the pose of the sensor in the file (VIEWPOINT).

    Arguments:
      path: File of the scan.
      format: Format of the scan. "auto" uses the name of the file, or the content of a .bin file (`detect_format`).

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the format is unknown, or the file is empty or malformed.
      ImportError: If the file is a .las file and the extra `las` is not installed.
    """
    path = Path(path)
    return scan_of_file(path, format=detect_format(path) if format == "auto" else format).cloud


def scan_of_file(
    path: Path,
    labels: Path | None = None,
    *,
    format: ScanFormat = "auto",
    records: RecordFormat = "kitti",
) -> Scan:
    """Read a scan with the laser numbers and times that its file contains, and its labels if `labels` is given.

    This is the `Recording.read` of scan files. The format "auto" does not use the content: `records` is the format of
    .bin files whose name does not define it.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a scan, found none")
    check_value(format, ScanFormat, f"{path}, format")
    file_format = (format_by_name(path) or records) if format == "auto" else format
    if is_headerless(file_format):
        scan = read_records(path, file_format)
    else:
        with _format_errors(path, file_format.partition("-")[0]):
            check_bytes(path.stat().st_size)
            scan = READERS[file_format](path)
    if labels is None:
        return scan
    return dataclasses.replace(scan, labels=read_labels(labels, points=len(scan.cloud)), labels_file=labels)


def read_labels(path: Path, *, points: int) -> Int32[np.ndarray, " n"]:
    """Return the raw SemanticKITTI ids (n,) of a .label file. The instance number in the upper 16 bits is dropped."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected labels, found none")
    size = path.stat().st_size
    if size != 4 * points:
        raise ValueError(f"{path}: expected {points} labels of 4 bytes, one per point of its scan, found {size} bytes")
    return (np.fromfile(path, dtype="<u4") & 0xFFFF).astype(np.int32)


def is_cloud_file(path: Path) -> bool:
    """Whether the path is a file with the ending of a point cloud map."""
    return path.suffix.lower() in BLOCKS and path.is_file()


def cloud_blocks(path: Path) -> Iterator[Float64[np.ndarray, "_ 3"]]:
    """Yield the points of a map in parts, in metres."""
    with _format_errors(path, path.suffix.lower()[1:]):
        yield from BLOCKS[path.suffix.lower()](path)


@contextlib.contextmanager
def _format_errors(path: Path, format: str) -> Iterator[None]:
    """Convert each error of a reader to a ValueError, or ImportError for a missing library, that names the file."""
    try:
        yield
    except ImportError as error:
        raise ImportError(f"{path}: {error}") from error
    except Exception as error:  # libraries raise many types for damaged files
        why = in_short(error, most=300)
        raise ValueError(f"{path}: expected a readable .{format} file, found an invalid one: {why}") from error
