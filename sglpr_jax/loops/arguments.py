"""Conversion and validation of scans and times from the Python API, before any work starts (`data.poses`: of poses)."""

import datetime
from typing import Any

import numpy as np

from sglpr_jax.data.poses import as_array, value_or_type
from sglpr_jax.data.scan import Scan

MOST_COLUMNS = 8
"""Maximum number of columns of an array of points (x, y, z, intensity and further fields). Wider arrays are images."""


def check_is(value: Any, kind: type, *, by: str) -> None:
    """Raise TypeError if `value` is not of type `kind`. `by` is the function of `sglpr_jax` that returns this type."""
    if not isinstance(value, kind):
        raise TypeError(f"expected a {kind.__name__}, found {value_or_type(value)}; sglpr_jax.{by} returns one")


def as_scan(scan: Any) -> Scan:
    """Convert points (n, 3) or an image (h, w) to a `Scan`. A `Scan` is returned unchanged."""
    if isinstance(scan, Scan):
        return scan
    expected = "points (n, 3) or an image (h, w)"
    array = as_array(scan, np.float32, expected, by="read_scan")
    if array.ndim != 2:
        raise ValueError(f"expected {expected}, found an array of shape {array.shape}")
    if 3 < array.shape[1] <= MOST_COLUMNS:
        raise ValueError(f"expected points (n, 3) of x, y and z only, found an array of shape {array.shape}")
    return Scan(points=array) if array.shape[1] == 3 else Scan(image=array)


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
        raise TypeError(f"expected a time in seconds, found {value_or_type(time)}") from error
    if not np.isfinite(seconds):
        raise ValueError(f"expected a time in seconds, found {seconds}")
    return seconds
