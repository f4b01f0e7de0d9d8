"""Reads points from numpy files: .npy and .npz."""

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from sglpr_jax.data.formats.cloud_text import MOST_POINTS, check_bytes
from sglpr_jax.files import in_short
from sglpr_jax.numpy_files import read_array

NAMES = ("points", "xyz", "pointcloud", "cloud", "scan")
"""Names of the array with the points in an .npz file with several arrays, in order of preference."""


def read_npy(path: Path) -> Float32[np.ndarray, "n 3"]:
    """Return the points (n, 3) of an .npy file.

    The file contains rows of numbers that begin with x, y, z, or records with the fields x, y and z. Pickled objects
    are not read.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file contains something else.
    """
    _check_exists(path)
    try:
        with path.open("rb") as stream:
            array = _read_scan(stream, size=path.stat().st_size)
    except Exception as error:  # numpy and tokenize raise many types for broken files
        raise ValueError(f"{path}: expected a numpy array, found none ({in_short(error)})") from error
    return _points(path, array)


def read_npz(path: Path) -> Float32[np.ndarray, "n 3"]:
    """Return the points (n, 3) of an .npz file, from the first array named in `NAMES` or from the only array.

    Raises what `read_npy` raises, and ValueError if the file has several arrays and no name matches.
    """
    _check_exists(path)
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
            chosen = _chosen(names)
            if chosen is not None:
                member = archive.getinfo(f"{chosen}.npy")
                with archive.open(member) as stream:
                    array = _read_scan(stream, size=member.file_size)
    except Exception as error:  # zipfile and zlib raise many types, too
        raise ValueError(f"{path}: expected a numpy array, found none ({in_short(error)})") from error
    if chosen is None:
        found = ", ".join(names) or "none"
        raise ValueError(f"{path}: expected one array, or one named {', '.join(NAMES)}, found {found}")
    return _points(path, array)


def _check_exists(path: Path) -> None:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a numpy file, found none")


def _chosen(names: Sequence[str]) -> str | None:
    """Name of the array with the points, or None."""
    return next((name for name in NAMES if name in names), names[0] if len(names) == 1 else None)


def _read_scan(stream: Any, *, size: int) -> np.ndarray:
    check_bytes(size)
    return read_array(stream, size=size)


def _points(path: Path, array: np.ndarray) -> Float32[np.ndarray, "n 3"]:
    """Return the fields x, y and z, or else the first three columns."""
    if {"x", "y", "z"} <= set(array.dtype.names or ()):
        array = np.stack([array[axis].reshape(-1) for axis in "xyz"], axis=1)
    numbers = array.dtype.kind in "fiu"
    if not numbers or array.ndim != 2 or not 3 <= array.shape[1] <= 32 or not 0 < len(array) <= MOST_POINTS:
        raise ValueError(
            f"{path}: expected points as rows of 3 to 32 numbers, found {array.dtype} of shape {array.shape}"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        return np.ascontiguousarray(array[:, :3], dtype=np.float32)
