"""Reads points from .las and .laz files with laspy (extra `las`)."""

import struct
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Float64

from sglpr_jax.data.formats.clouds import BLOCK_POINTS, check_points, cloud_scan
from sglpr_jax.data.scan import Scan, time_field_of

_RECORD_HEADER, _EXTENDED_RECORD_HEADER = 54, 60
"""Minimum size of a variable-length record before and after the points, in bytes."""
_COMPRESSED = 0x80
"""Bit of the point format in the header of a .laz file."""


def las_scan(path: Path) -> Scan:
    """Read the points of a .las file in metres, scaled by the header, and their times. The axes are not changed."""
    with _laspy(path, one_scan=True).open(path) as stream:
        points = stream.read()
    time = time_field_of(list(points.point_format.dimension_names))
    names = ("x", "y", "z") if time is None else ("x", "y", "z", time)
    return cloud_scan({name: np.asarray(points[name]) for name in names}, time=time)


def las_blocks(path: Path) -> Iterator[Float64[np.ndarray, "_ 3"]]:
    """Yield the points of a .las or .laz file of any size in parts, in metres. .laz files need lazrs."""
    laspy = _laspy(path, one_scan=False)
    if path.suffix.lower() == ".laz" and not laspy.LazBackend.detect_available():
        raise ImportError(".laz files need lazrs (pip install 'sglpr-jax[las]')")
    with laspy.open(path) as stream:
        for block in stream.chunk_iterator(BLOCK_POINTS):
            yield np.stack([np.asarray(axis, np.float64) for axis in (block.x, block.y, block.z)], axis=1)


def _laspy(path: Path, *, one_scan: bool) -> ModuleType:
    """Return the library after a check of the sizes in the header: laspy would read 2**32 missing records.

    Raises ValueError if the file is shorter than its header declares, or larger than a scan if it is one.
    """
    try:
        import laspy
    except ImportError as error:
        raise ImportError(".las files need the extra `las` (pip install 'sglpr-jax[las]')") from error
    size = path.stat().st_size
    with path.open("rb") as stream:
        header = stream.read(375).ljust(375, b"\0")
    if header[:4] != b"LASF" or size < 227:
        raise ValueError(f"expected a .las file, found an unreadable one ({size} bytes, which begin {header[:4]!r})")
    header_size, start, records, kind, width, points = struct.unpack_from("<HIIBHI", header, 94)
    extended_start = extended = 0
    if header[25] >= 4:  # version 1.4 has numbers of 64 bits
        extended_start, extended, points = struct.unpack_from("<QIQ", header, 235)
    missing = header_size + records * _RECORD_HEADER > start
    if missing or (extended and extended_start + extended * _EXTENDED_RECORD_HEADER > size):
        raise ValueError(f"expected {records} and {extended} records by the header, found {size} bytes in total")
    if one_scan:
        check_points(points, bytes_each=width)
    available = max(size - start, 0) // max(width, 1)
    # The size of compressed points is not known. Versions from 1.3 on may have records behind the points.
    if not kind & _COMPRESSED and (points > available or (points < available and header[25] < 3)):
        raise ValueError(f"expected {points} points by the header, found {available}")
    return laspy
