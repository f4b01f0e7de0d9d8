"""Reads points from numpy files: .npy and .npz."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

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
    return _points(path, _load(path, lambda array: array))


def read_npz(path: Path) -> Float32[np.ndarray, "n 3"]:
    """Return the points (n, 3) of an .npz file, from the first array named in `NAMES` or from the only array.

    Raises what `read_npy` raises, and ValueError if the file has several arrays and no name matches.
    """
    return _points(path, _load(path, lambda archive: archive[_name(path, archive.files)]))


def _name(path: Path, names: Sequence[str]) -> str:
    """Name of the array with the points."""
    name = next((name for name in NAMES if name in names), names[0] if len(names) == 1 else None)
    if name is None:
        found = ", ".join(names) or "none"
        raise _NotOne(f"{path}: expected one array, or one named {', '.join(NAMES)}, found {found}")
    return name


class _NotOne(ValueError):
    """Raised if an archive has no single array with points. `_load` does not wrap it."""


def _load(path: Path, choose: Callable[[Any], np.ndarray]) -> np.ndarray:
    """Load a file with numpy and select an array with `choose`. Raises ValueError if numpy cannot read the file."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a numpy file, found none")
    try:
        with path.open("rb") as stream:
            return choose(np.load(stream, allow_pickle=False))
    except _NotOne:
        raise
    except Exception as error:  # numpy, zipfile, zlib and tokenize raise many types for broken files
        raise ValueError(f"{path}: expected a numpy array, found none ({error})") from error


def _points(path: Path, array: np.ndarray) -> Float32[np.ndarray, "n 3"]:
    """Return the fields x, y and z, or else the first three columns."""
    if {"x", "y", "z"} <= set(array.dtype.names or ()):
        array = np.stack([array[axis].reshape(-1) for axis in "xyz"], axis=1)
    numbers = array.dtype.kind in "fiu"
    if not numbers or array.ndim != 2 or not 3 <= array.shape[1] <= 32 or not len(array):
        raise ValueError(
            f"{path}: expected points as rows of 3 to 32 numbers, found {array.dtype} of shape {array.shape}"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        return np.ascontiguousarray(array[:, :3], dtype=np.float32)
