"""Points from numpy's own files: .npy and .npz."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

NAMES = ("points", "xyz", "pointcloud", "cloud", "scan")
"""Which array of an .npz holds the points, where there are several."""


def read_npy(path: Path) -> Float32[np.ndarray, "n 3"]:
    """Return the points (n, 3) of an .npy file: rows of numbers, x, y and z first, or records that have such fields.

    Raises FileNotFoundError, and ValueError where it holds something else. Pickled objects are not read.
    """
    return _points(path, _load(path, lambda array: array))


def read_npz(path: Path) -> Float32[np.ndarray, "n 3"]:
    """Return the points (n, 3) of an .npz file: of its only array, or of the one called points, xyz and the like.

    Raises what `read_npy` raises.
    """
    return _points(path, _load(path, lambda archive: archive[_name(path, archive.files)]))


def _name(path: Path, names: Sequence[str]) -> str:
    """Which array of an archive holds the points."""
    name = next((name for name in NAMES if name in names), names[0] if len(names) == 1 else None)
    if name is None:
        found = ", ".join(names) or "none"
        raise _NotOne(f"{path}: expected one array, or one called {', '.join(NAMES)}, found {found}")
    return name


class _NotOne(ValueError):
    """An archive holds several arrays; the message says so already."""


def _load(path: Path, choose: Callable[[Any], np.ndarray]) -> np.ndarray:
    """What `choose` takes of what numpy reads; one clear error where it reads nothing."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with path.open("rb") as stream:
            return choose(np.load(stream, allow_pickle=False))
    except _NotOne:
        raise
    except Exception as error:  # numpy, zipfile, zlib and tokenize raise a dozen kinds for broken files
        raise ValueError(f"{path}: expected an array of numpy's, found none ({error})") from error


def _points(path: Path, array: np.ndarray) -> Float32[np.ndarray, "n 3"]:
    """The first three columns, or the fields x, y and z."""
    if {"x", "y", "z"} <= set(array.dtype.names or ()):
        array = np.stack([array[axis].reshape(-1) for axis in "xyz"], axis=1)
    numbers = array.dtype.kind in "fiu"
    if not numbers or array.ndim != 2 or not 3 <= array.shape[1] <= 32 or not len(array):
        raise ValueError(
            f"{path}: expected points as rows (n, 3) or more of numbers, found {array.dtype} of shape {array.shape}"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        return np.ascontiguousarray(array[:, :3], dtype=np.float32)
