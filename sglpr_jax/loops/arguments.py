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
    """Raise TypeError if `value` is not of type `kind`. The message names `by`, the function that returns one."""
    if not isinstance(value, kind):
        raise TypeError(f"expected a {kind.__name__}, found {_value_or_type(value)}; sglpr_jax.{by} returns one")


def as_scan(scan: Any) -> Scan:
    """Convert points (n, 3) or an image (h, w) to a `Scan`. Accepts a `Scan`, too."""
    if isinstance(scan, Scan):
        return scan
    expected = "points (n, 3) or an image (h, w)"
    values = _numbers(scan, np.float32, expected, by="read_scan")
    if values.ndim != 2:
        raise ValueError(f"expected {expected}, found an array of shape {values.shape}")
    if 3 < values.shape[1] <= MOST_COLUMNS:
        raise ValueError(f"expected points (n, 3) of x, y and z only, found an array of shape {values.shape}")
    return Scan(points=values) if values.shape[1] == 3 else Scan(image=values)


def as_pose(odometry: Any) -> Float[np.ndarray, "4 4"] | None:
    """Convert a pose to a 4 x 4 array. Returns None for None."""
    return None if odometry is None else _poses(odometry, "odometry (4, 4)", 2)


def as_poses(poses: Any, *, of: str) -> Float[np.ndarray, "n 4 4"]:
    """Convert an array or a list of 4 x 4 arrays to poses. Errors name them by `of`, for instance "odometry"."""
    return _poses(poses, f"{of} (n, 4, 4)", 3)


def _poses(values: Any, expected: str, ndim: int) -> Float[np.ndarray, "*n 4 4"]:
    """Convert to finite matrices that contain a rotation and have the last row 0 0 0 1."""
    poses = _numbers(values, np.float64, expected, by="read_odometry")
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
    """Convert a time to a number, and a date to seconds. Returns None for None."""
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


def _numbers(values: Any, dtype: type, expected: str, *, by: str) -> np.ndarray:
    """Convert to an array of numbers, or raise TypeError. For a path, the message names the reader `by`."""
    if isinstance(values, str | os.PathLike):
        raise TypeError(f"expected {expected}, found the path {values}; read it with sglpr_jax.{by}")
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError) as error:
        raise TypeError(f"expected {expected}, found {_value_or_type(values)} ({in_short(error)})") from error


def _value_or_type(value: Any) -> str:
    """The value itself if it is a string or path, otherwise its type."""
    return f"{value!r}" if isinstance(value, str | os.PathLike) else f"a {type(value).__name__}"
