"""Reads points from .las and .laz files with laspy (extra `las`)."""

import math
import struct
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float64

from sglpr_jax.data.formats.clouds import BLOCK_POINTS, check_points, cloud_scan
from sglpr_jax.data.scan import TIME_FIELDS, Scan
from sglpr_jax.extras import install_command, optional_module
from sglpr_jax.files import warn

_RECORD_HEADER, _EXTENDED_RECORD_HEADER = 54, 60
"""Minimum size of a variable-length record (before the points) and of an extended one (after them), in bytes."""
_COMPRESSED = 0x80
"""Bit that is set in the point format of a .laz file."""
_SHORTEST_HEADER, _LONGEST_HEADER = 227, 375
"""Size of the header of versions 1.0 and 1.4, in bytes."""


def las_scan(path: Path) -> Scan:
    """Read the points of a .las file in metres, and their times if it has any. The axes are not changed."""
    with _checked_laspy(path, one_scan=True).open(path) as stream:
        points = stream.read()  # laspy applies the scale and offset of the header to x, y and z
    names = set(points.point_format.dimension_names)
    columns = dict(zip("xyz", _coordinates(points, path), strict=True))
    return cloud_scan(columns | {name: np.asarray(points[name]) for name in TIME_FIELDS if name in names})


def las_blocks(path: Path) -> Iterator[Float64[np.ndarray, "_ 3"]]:
    """Yield the points of a .las or .laz file in blocks of `BLOCK_POINTS`, in metres. .laz files need lazrs."""
    laspy_module(compressed=path.suffix.lower() == ".laz")
    laspy = _checked_laspy(path, one_scan=False)
    with laspy.open(path) as stream:
        for block in stream.chunk_iterator(BLOCK_POINTS):
            yield np.stack(_coordinates(block, path), axis=1)


def laspy_module(*, compressed: bool = False) -> ModuleType:
    """Return the module laspy. Raises ImportError if it is not installed, or lazrs, which `compressed` files need."""
    laspy = optional_module("laspy", "reading of .las files", extra="las")
    if compressed and not laspy.LazBackend.detect_available():
        raise ImportError(f".laz files need lazrs: {install_command('las')}")
    return laspy


def _coordinates(points: Any, path: Path) -> list[Float64[np.ndarray, " n"]]:
    """Return x, y and z of points in metres. Those at the limit of their integers, which cuts values off, are NaN."""
    limits = np.iinfo(np.int32)
    axes, cut_off = list[np.ndarray](), 0
    for name in "xyz":
        integers = np.asarray(points[name.upper()])
        is_cut_off = (integers == limits.min) | (integers == limits.max)
        axes.append(np.where(is_cut_off, np.nan, np.asarray(points[name], np.float64)))
        cut_off += int(is_cut_off.sum())
    if cut_off:
        warn(f"{path}: {cut_off} coordinates are at the limit of the format, so their points are left out")
    return axes


def _checked_laspy(path: Path, *, one_scan: bool) -> ModuleType:
    """Check the sizes in the header of a .las file, which laspy does not check, and return the module laspy.

    Raises ValueError if the file is shorter than its header declares or, with `one_scan`, has too many points.
    """
    laspy = laspy_module()
    size = path.stat().st_size
    with path.open("rb") as stream:
        header = stream.read(_LONGEST_HEADER).ljust(_LONGEST_HEADER, b"\0")
    if header[:4] != b"LASF" or size < _SHORTEST_HEADER:
        raise ValueError(f"expected a .las file, found an unreadable one ({size} bytes, which begin {header[:4]!r})")
    minor_version = header[25]
    scales, offsets = struct.unpack_from("<3d", header, 131), struct.unpack_from("<3d", header, 155)
    if not (all(map(math.isfinite, scales + offsets)) and min(scales) > 0):
        raise ValueError(f"expected positive scales and finite offsets, found {scales} and {offsets}")
    header_size, points_start, records, point_format, width, points = struct.unpack_from("<HIIBHI", header, 94)
    extended_start = extended = 0  # offset and number of the extended records
    if minor_version >= 4:
        extended_start, extended, points = struct.unpack_from("<QIQ", header, 235)
    records_end = header_size + records * _RECORD_HEADER
    extended_end = extended_start + extended * _EXTENDED_RECORD_HEADER
    if records_end > points_start or (extended and extended_end > size):
        raise ValueError(f"expected {records} and {extended} records by the header, found {size} bytes in total")
    if one_scan:
        check_points(points, bytes_each=width)
    if point_format & _COMPRESSED:
        return laspy  # the size of compressed points is not known
    available = max(size - points_start, 0) // max(width, 1)
    # Versions from 1.3 on may have records after the points.
    if points > available or (points < available and minor_version < 3):
        raise ValueError(f"expected {points} points by the header, found {available}")
    return laspy
