"""Reads points from numpy files: .npy and .npz."""

import zipfile
from pathlib import Path

import numpy as np

from sglpr_jax.data.formats.clouds import MOST_POINTS, check_bytes, cloud_scan
from sglpr_jax.data.scan import Scan
from sglpr_jax.numpy_files import read_array

NAMES = ("points", "xyz", "pointcloud", "cloud", "scan")
"""Names of the array with the points in an .npz file with several arrays, in order of preference."""


def array_scan(path: Path) -> Scan:
    """Read the points of an .npy or .npz file: rows of numbers that begin with x, y, z, or records with such fields.

    In an .npz file, they are the first array of `NAMES`, or the only one. Pickled objects are not read.
    """
    if path.suffix.lower() == ".npz":
        array = _archived(path)
    else:
        with path.open("rb") as stream:
            array = read_array(stream, size=path.stat().st_size)
    if {"x", "y", "z"} <= set(array.dtype.names or ()):
        array = np.stack([array[axis].reshape(-1) for axis in "xyz"], axis=1)
    numbers = array.dtype.kind in "fiu"
    if not numbers or array.ndim != 2 or not 3 <= array.shape[1] <= 32 or not 0 < len(array) <= MOST_POINTS:
        raise ValueError(f"expected points as rows of 3 to 32 numbers, found {array.dtype} of shape {array.shape}")
    return cloud_scan(dict(zip("xyz", array.T, strict=False)))


def _archived(path: Path) -> np.ndarray:
    with zipfile.ZipFile(path) as archive:
        members = {one.filename: one for one in archive.infolist() if one.filename.endswith(".npy")}
        names = [f"{name}.npy" for name in NAMES if f"{name}.npy" in members] or list(members)
        if (len(members) > 1 and names == list(members)) or not names:
            found = ", ".join(name.removesuffix(".npy") for name in members) or "none"
            raise ValueError(f"expected one array, or one named {', '.join(NAMES)}, found {found}")
        member = members[names[0]]
        check_bytes(member.file_size)
        with archive.open(member) as stream:
            return read_array(stream, size=member.file_size)
