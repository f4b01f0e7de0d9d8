"""Reads points from .las files with laspy (extra `las`)."""

import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from sglpr_jax.data.formats.scan_size import check_points
from sglpr_jax.files import in_short, naming

_RECORD_HEADER, _EXTENDED_RECORD_HEADER = 54, 60
"""Minimum size of a variable-length record before and after the points, in bytes."""


def read_las(path: Path) -> Float32[np.ndarray, "n 3"]:
    """Return the points (n, 3) of a .las file in metres, scaled by the header. The axes are not changed.

    Raises:
      FileNotFoundError: If the file does not exist.
      ImportError: If the extra `las` is not installed.
      ValueError: If the file is not a readable .las file, is truncated, or has no points.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a .las file, found none")
    try:
        import laspy
    except ImportError as error:
        raise ImportError(f"{path}: .las files need the extra `las` (pip install 'sglpr-jax[las]')") from error
    with naming(path):
        _check_sizes(path)
    try:
        with laspy.open(path) as stream:
            found = stream.read()
        with np.errstate(over="ignore", invalid="ignore"):
            return np.stack([np.asarray(axis) for axis in (found.x, found.y, found.z)], axis=1).astype(np.float32)
    except Exception as error:  # laspy raises struct.error, MemoryError and others
        raise ValueError(f"{path}: expected a .las file, found an unreadable one ({in_short(error)})") from error


def _check_sizes(path: Path) -> None:
    """Raise ValueError if the file is shorter than its header declares. laspy would read 2**32 missing records."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        header = stream.read(375).ljust(375, b"\0")
    if header[:4] != b"LASF" or size < 227:
        raise ValueError(f"expected a .las file, found an unreadable one ({size} bytes, which begin {header[:4]!r})")
    header_size, start, records, _, width, points = struct.unpack_from("<HIIBHI", header, 94)
    extended_start = extended = 0
    if header[25] >= 4:  # version 1.4 has numbers of 64 bits
        extended_start, extended, points = struct.unpack_from("<QIQ", header, 235)
    missing = header_size + records * _RECORD_HEADER > start
    if missing or (extended and extended_start + extended * _EXTENDED_RECORD_HEADER > size):
        raise ValueError(f"expected {records} and {extended} records by the header, found {size} bytes in total")
    check_points(points, bytes_each=width)
    held = max(size - start, 0) // max(width, 1)
    if points > held or (points < held and header[25] < 3):  # later versions may have records behind the points
        raise ValueError(f"expected {points} points by the header, found {held}")
