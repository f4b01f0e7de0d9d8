"""Validation of arguments of the Python API, before any work starts."""

import datetime
import os
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.data.recording import Record
from sglpr_jax.files import in_short
from sglpr_jax.se3 import ROTATION_TOLERANCE, are_rotations

MOST_COLUMNS = 8
"""Maximum number of columns of an array of points (x, y, z, intensity and further fields). Wider arrays are images."""


def check_is(value: Any, kind: type, *, by: str) -> None:
    """Raise TypeError if `value` is not of type `kind`. The message names `by`, the function that returns one."""
    if not isinstance(value, kind):
        raise TypeError(f"expected a {kind.__name__}, found {_said(value)}; sglpr_jax.{by} returns one")


def given_record(scan: Any) -> Record:
    """Convert points (n, 3) or an image (h, w) to a record. Accepts records, too."""
    if isinstance(scan, Record):
        return scan
    expected = "points (n, 3) or an image (h, w)"
    values = _numbers(scan, np.float32, expected, by="read_scan")
    if values.ndim != 2:
        raise ValueError(f"expected {expected}, found an array of shape {values.shape}")
    if 3 < values.shape[1] <= MOST_COLUMNS:
        raise ValueError(f"expected points (n, 3) of x, y and z only, found an array of shape {values.shape}")
    return Record(points=values) if values.shape[1] == 3 else Record(image=values)


def given_pose(odometry: Any) -> Float[np.ndarray, "4 4"] | None:
    """Convert a pose to a 4 x 4 array. Returns None for None."""
    if odometry is None:
        return None
    expected = "odometry as a 4 x 4 pose with a rotation"
    pose = _numbers(odometry, np.float64, expected, by="read_odometry")
    if pose.shape != (4, 4) or not _are_poses(pose):
        raise ValueError(f"expected {expected}, found {pose.tolist()!s:.200}")
    return pose


def given_poses(poses: Any, *, of: str) -> Float[np.ndarray, "n 4 4"]:
    """Convert an array or a list of 4 x 4 arrays to poses. Errors name them by `of`, for instance "odometry"."""
    expected = f"{of} (n, 4, 4)"
    values = _numbers(poses, np.float64, expected, by="read_odometry")
    if values.ndim != 3 or values.shape[1:] != (4, 4):
        raise ValueError(f"expected {expected}, found an array of shape {values.shape}")
    wrong = ~_are_poses(values)
    if wrong.any():
        row = int(wrong.argmax())
        raise ValueError(f"expected {expected}, with rotations, found {values[row].tolist()} in row {row}")
    return values


def given_time(time: Any) -> float | None:
    """Convert a time to a number, and a date to seconds. Returns None for None."""
    if time is None:
        return None
    if isinstance(time, datetime.datetime):
        time = np.datetime64(time.astimezone(datetime.UTC).replace(tzinfo=None))
    try:
        if isinstance(time, np.datetime64):
            return given_time(time - np.datetime64(0, "s"))
        if isinstance(time, np.timedelta64 | datetime.timedelta):
            seconds = float(np.timedelta64(time) / np.timedelta64(1, "s"))
        else:
            seconds = float(time)
    except (TypeError, ValueError) as error:
        raise TypeError(f"expected a time in seconds, found {_said(time)}") from error
    if not np.isfinite(seconds):
        raise ValueError(f"expected a time in seconds, found {seconds}")
    return seconds


def _are_poses(poses: Float[np.ndarray, "*n 4 4"]) -> Bool[np.ndarray, "*n"]:
    """Whether each matrix is finite, contains a rotation, and has the last row 0 0 0 1."""
    last = np.abs(poses[..., 3, :] - [0, 0, 0, 1]).max(-1, initial=0) < ROTATION_TOLERANCE
    return np.asarray(np.isfinite(poses).all((-2, -1)) & are_rotations(poses[..., :3, :3]) & last)


def _numbers(values: Any, dtype: type, expected: str, *, by: str) -> np.ndarray:
    """Convert to an array of numbers, or raise TypeError. For a path, the message names the reader `by`."""
    if isinstance(values, str | os.PathLike):
        raise TypeError(f"expected {expected}, found the path {values}; read it with sglpr_jax.{by}")
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError) as error:
        raise TypeError(f"expected {expected}, found {_said(values)} ({in_short(error)})") from error


def _said(value: Any) -> str:
    """The value itself if it is a string or path, otherwise its type."""
    return f"{value!r}" if isinstance(value, str | os.PathLike) else f"a {type(value).__name__}"
