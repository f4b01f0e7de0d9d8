"""Reads points from numpy files: .npy and .npz."""

import zipfile
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from sglpr_jax.data.formats.clouds import MOST_POINTS, check_bytes
from sglpr_jax.files import in_short
from sglpr_jax.numpy_files import read_array

NAMES = ("points", "xyz", "pointcloud", "cloud", "scan")
"""Names of the array with the points in an .npz file with several arrays, in order of preference."""


def read_points(path: Path) -> Float32[np.ndarray, "n 3"]:
    """Return the points (n, 3) of an .npy or .npz file.

    An array has rows of numbers that begin with x, y, z, or records with the fields x, y and z. In an .npz file, it is
    the first array of `NAMES`, or the only one. Pickled objects are not read.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file contains something else.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a numpy file, found none")
    try:
        array = _archived(path) if path.suffix.lower() == ".npz" else _lone(path)
    except Exception as error:  # numpy, tokenize, zipfile and zlib raise many types for broken files
        raise ValueError(f"{path}: expected a numpy array, found none ({in_short(error)})") from error
    if {"x", "y", "z"} <= set(array.dtype.names or ()):
        array = np.stack([array[axis].reshape(-1) for axis in "xyz"], axis=1)
    numbers = array.dtype.kind in "fiu"
    if not numbers or array.ndim != 2 or not 3 <= array.shape[1] <= 32 or not 0 < len(array) <= MOST_POINTS:
        raise ValueError(
            f"{path}: expected points as rows of 3 to 32 numbers, found {array.dtype} of shape {array.shape}"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        return np.ascontiguousarray(array[:, :3], dtype=np.float32)


def _lone(path: Path) -> np.ndarray:
    size = path.stat().st_size
    check_bytes(size)
    with path.open("rb") as stream:
        return read_array(stream, size=size)


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
