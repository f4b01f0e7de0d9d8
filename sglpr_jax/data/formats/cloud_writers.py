"""Writes point clouds as .ply, .pcd, .las and .laz files."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64
from numpy.typing import ArrayLike

from sglpr_jax.data.formats.las import laspy_module
from sglpr_jax.files import replacing

LAS_STEP_M = 0.001
"""Resolution of the coordinates in .las files, in metres."""
EXACT_M = 16_000.0
"""Largest coordinate that 32 bits store to a millimetre, in metres. Larger ones, such as those of UTM, get 64 bits."""


def write_cloud(path: Path | str, points: ArrayLike) -> None:
    """Write a point cloud in metres, in the format of the suffix: .ply, .pcd, .las or .laz (the last two: extra `las`).

    Raises ValueError for another suffix, ImportError without the extra, WriteError if the file cannot be written.
    """
    path, points = Path(path), as_cloud(points)
    check_cloud_path(path)
    with replacing(path) as temporary:
        WRITERS[path.suffix.lower()](temporary, points)


def check_cloud_path(path: Path) -> None:
    """Raise ValueError if no format has the suffix of the path, ImportError if its format needs a missing package."""
    suffix = path.suffix.lower()
    if suffix not in WRITERS:
        raise ValueError(f"{path}: expected a name that ends in {', '.join(WRITERS)}, found {suffix or 'no suffix'}")
    if suffix in (".las", ".laz"):
        laspy_module(compressed=suffix == ".laz")


def as_cloud(points: ArrayLike) -> Float64[np.ndarray, "n 3"]:
    """Convert an array to a point cloud. Raises ValueError without points, for other shapes and for infinite values."""
    cloud = np.asarray(points, np.float64)
    if cloud.ndim != 2 or cloud.shape[1] != 3 or not len(cloud) or not np.isfinite(cloud).all():
        raise ValueError(f"expected finite points (n, 3), found {'none' if not cloud.size else f'shape {cloud.shape}'}")
    return cloud


def _write_ply(path: Path, points: Float[np.ndarray, "n 3"]) -> None:
    values = _narrow(points)
    name = "float" if values.itemsize == 4 else "double"
    properties = "".join(f"property {name} {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + values.tobytes())


def _write_pcd(path: Path, points: Float[np.ndarray, "n 3"]) -> None:
    values = _narrow(points)
    size, count = values.itemsize, len(points)
    header = (
        f"VERSION 0.7\nFIELDS x y z\nSIZE {size} {size} {size}\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
    )
    path.write_bytes(header.encode() + values.tobytes())


def _write_las(path: Path, points: Float[np.ndarray, "n 3"], *, compressed: bool) -> None:
    laspy = laspy_module()
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.global_encoding.wkt = True  # this point format requires it
    header.offsets, header.scales = np.floor(points.min(axis=0)), np.full(3, LAS_STEP_M)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.return_number[:] = cloud.number_of_returns[:] = 1
    with path.open("wb") as stream:
        cloud.write(stream, do_compress=compressed)


def _narrow(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the points with 32 bits for each coordinate, or 64 if they are too large."""
    return points.astype("<f4" if np.abs(points).max(initial=0.0) < EXACT_M else "<f8")


WRITERS: dict[str, Callable[[Path, np.ndarray], None]] = {
    ".ply": _write_ply,
    ".pcd": _write_pcd,
    ".las": partial(_write_las, compressed=False),
    ".laz": partial(_write_las, compressed=True),
}
"""Functions that write a point cloud to a path, by suffix."""
