"""What is handed in from Python, as the loops need it: what it cannot be is one clear error, before any work."""

import os
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.record import Record
from sglpr_jax.files import in_short
from sglpr_jax.poses import are_rotations

MOST_COLUMNS = 8
"""No image is as narrow; points with so many are rows of a file, with intensity and more."""


def check_is(value: Any, kind: type, *, by: str) -> None:
    """Raise TypeError unless a value is of this kind, which one gets `by` a function of the package."""
    if not isinstance(value, kind):
        raise TypeError(f"expected a {kind.__name__}, which sglpr_jax.{by} gives, found {_said(value)}")


def given_record(scan: Any, *, mounting: Mounting | None = None) -> Record:
    """A scan or image as a record: one already, points (n, 3) of a sensor mounted so, or an image (h, w)."""
    if isinstance(scan, Record):
        return scan
    expected = "points (n, 3) or an image (h, w)"
    values = _numbers(scan, np.float32, expected, by="read_scan")
    if values.ndim != 2:
        raise ValueError(f"expected {expected}, found an array of shape {values.shape}")
    if 3 < values.shape[1] <= MOST_COLUMNS:
        raise ValueError(f"expected points of x, y and z alone, (n, 3), found an array of shape {values.shape}")
    return Record(points=values, mounting=mounting) if values.shape[1] == 3 else Record(image=values)


def given_pose(odometry: Any) -> Float[np.ndarray, "4 4"] | None:
    """The pose of one frame, if there is one."""
    if odometry is None:
        return None
    expected = "odometry as a 4 x 4 pose with a rotation"
    pose = _numbers(odometry, np.float64, expected, by="read_odometry")
    if pose.shape != (4, 4) or not _are_poses(pose):
        raise ValueError(f"expected {expected}, found {pose.tolist()!s:.200}")
    return pose


def given_poses(poses: Any, *, of: str) -> Float[np.ndarray, "n 4 4"]:
    """Poses as an array: an array already, or a list of 4 x 4 arrays; `of` says what they are: "odometry"."""
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
    """Seconds, if they are said."""
    if time is None:
        return None
    try:
        seconds = float(time)
    except (TypeError, ValueError) as error:
        raise TypeError(f"expected a time in seconds, found {_said(time)}") from error
    if not np.isfinite(seconds):
        raise ValueError(f"expected a time in seconds, found {seconds}")
    return seconds


def _are_poses(poses: Float[np.ndarray, "*n 4 4"]) -> Bool[np.ndarray, "*n"]:
    """Whether each is finite and has a rotation."""
    return np.asarray(np.isfinite(poses).all((-2, -1)) & are_rotations(poses[..., :3, :3]))


def _numbers(values: Any, dtype: type, expected: str, *, by: str) -> np.ndarray:
    """The numbers of an array or a list; TypeError for what holds none, `by` what they are read from a file."""
    if isinstance(values, str | os.PathLike):
        raise TypeError(f"expected {expected}, found the path {values}: sglpr_jax.{by} reads it")
    try:
        return np.asarray(values, dtype)
    except (TypeError, ValueError) as error:
        raise TypeError(f"expected {expected}, found {_said(values)} ({in_short(error)})") from error


def _said(value: Any) -> str:
    """The kind of a value, and what it is where that is short."""
    return f"{value!r}" if isinstance(value, str | os.PathLike) else f"a {type(value).__name__}"
