"""Conversion and validation of the arguments of the Python API, before any work starts."""

import datetime
import os
from typing import Any

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.scan import Scan
from sglpr_jax.files import in_short
from sglpr_jax.se3 import ROTATION_TOLERANCE, are_rotations

MOST_COLUMNS = 8
"""Maximum number of columns of an array of points (x, y, z, intensity and further fields). Wider arrays are images."""


def check_is(value: Any, kind: type, *, by: str) -> None:
    """Raise TypeError if `value` is not of type `kind`. `by` is the function of `sglpr_jax` that returns this type."""
    if not isinstance(value, kind):
        raise TypeError(f"expected a {kind.__name__}, found {_value_or_type(value)}; sglpr_jax.{by} returns one")


def as_scan(scan: Any) -> Scan:
    """Convert points (n, 3) or an image (h, w) to a `Scan`. A `Scan` is returned unchanged."""
    if isinstance(scan, Scan):
        return scan
    expected = "points (n, 3) or an image (h, w)"
    array = _as_array(scan, np.float32, expected, by="read_scan")
    if array.ndim != 2:
        raise ValueError(f"expected {expected}, found an array of shape {array.shape}")
    if 3 < array.shape[1] <= MOST_COLUMNS:
        raise ValueError(f"expected points (n, 3) of x, y and z only, found an array of shape {array.shape}")
    return Scan(points=array) if array.shape[1] == 3 else Scan(image=array)


def as_pose(odometry: Any) -> Float[np.ndarray, "4 4"] | None:
    """Convert a pose to a 4 x 4 array. Returns None for None."""
    return None if odometry is None else _checked_poses(odometry, "odometry (4, 4)", 2)


def as_poses(poses: Any, *, of: str) -> Float[np.ndarray, "n 4 4"]:
    """Convert an array or a list of 4 x 4 arrays to poses. Errors name them by `of`, for instance "odometry"."""
    return _checked_poses(poses, f"{of} (n, 4, 4)", 3)


def _checked_poses(values: Any, expected: str, ndim: int) -> Float[np.ndarray, "*n 4 4"]:
    """Convert to an array of poses of `ndim` axes: finite matrices with a rotation and the last row 0 0 0 1."""
    poses = _as_array(values, np.float64, expected, by="read_odometry")
    if poses.ndim != ndim or poses.shape[-2:] != (4, 4):
        raise ValueError(f"expected {expected}, found an array of shape {poses.shape}")
    matrices = poses.reshape(-1, 4, 4)
    valid = np.isfinite(matrices).all((-2, -1)) & are_rotations(matrices[:, :3, :3])
    valid &= np.abs(matrices[:, 3] - [0, 0, 0, 1]).max(-1) < ROTATION_TOLERANCE
    if not valid.all():
        row = int(valid.argmin())
        raise ValueError(f"expected {expected}, with rotations, found {matrices[row].tolist()} in row {row}")
    return poses


def as_seconds(time: Any) -> float | None:
    """Convert a date or a duration to seconds, and any other time to a number. Returns None for None."""
    if time is None:
        return None
    if isinstance(time, datetime.datetime):
        time = time.astimezone(datetime.UTC).timestamp()
    elif isinstance(time, datetime.timedelta):
        time = time.total_seconds()
    elif isinstance(time, np.datetime64):
        time = time - np.datetime64(0, "s")
    try:
        seconds = float(time / np.timedelta64(1, "s") if isinstance(time, np.timedelta64) else time)
    except (TypeError, ValueError) as error:
        raise TypeError(f"expected a time in seconds, found {_value_or_type(time)}") from error
    if not np.isfinite(seconds):
        raise ValueError(f"expected a time in seconds, found {seconds}")
    return seconds


def _as_array(values: Any, dtype: type, expected: str, *, by: str) -> np.ndarray:
    """Convert to an array of numbers, or raise TypeError. For a path, the message names its reader, `by`."""
    if isinstance(values, str | os.PathLike):
        raise TypeError(f"expected {expected}, found the path {values}; read it with sglpr_jax.{by}")
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError) as error:
        raise TypeError(f"expected {expected}, found {_value_or_type(values)} ({in_short(error)})") from error


def _value_or_type(value: Any) -> str:
    """The value itself if it is a string or path, otherwise its type."""
    return f"{value!r}" if isinstance(value, str | os.PathLike) else f"a {type(value).__name__}"
