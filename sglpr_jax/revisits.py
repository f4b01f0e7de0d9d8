"""Revisits: frames with a nearby frame in their own past or in a database."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from sglpr_jax.same_place import EXCLUDED_FRAMES, EXCLUDED_S, POSITIVE_M
from sglpr_jax.se3 import distances

BLOCK = 32
"""Number of queries whose positions are compared at a time, so that the distances fit in the cache."""

Near = Callable[[Float[np.ndarray, "..."]], Bool[np.ndarray, "..."]]
"""Function from distances in metres to whether they are within one place, such as `lambda apart: apart < 5`."""


def close_pairs(positions: Float[np.ndarray, "n d"], *, closer_than_m: float) -> Int[np.ndarray, "pairs 2"]:
    """Return every pair of frames less than `closer_than_m` metres apart, each once and in no order."""
    return KDTree(positions).query_pairs(np.nextafter(closer_than_m, 0), output_type="ndarray")


def database_end(
    n: int,
    *,
    times: Float[np.ndarray, " n"] | None = None,
    excluded_s: float = EXCLUDED_S,
    excluded_frames: int = EXCLUDED_FRAMES,
) -> Int[np.ndarray, " n"]:
    """Return for each of `n` frames the length of its database: the number of first frames that it is compared with.

    0 means that the frame is not a query. The rule is LoGG3D-Net's. A frame in the first `excluded_s` seconds is not a
    query. The database of any other query at time t is frames `[:k + 1]`, where k is the first frame with a time > t -
    `excluded_s`. So one frame of the database is a little younger than `excluded_s`.

    Arguments:
      n: Number of frames.
      times: Time of each frame, in seconds. Without times, the frame number is the clock and `excluded_frames` the
        limit.
      excluded_s: Minimum age in seconds.
      excluded_frames: Minimum age in frames.

    Raises:
      ValueError: If times are not finite or decrease.
    """
    clock, excluded = (np.arange(n, dtype=np.float64), excluded_frames) if times is None else (times, excluded_s)
    if not np.all(np.isfinite(clock)) or np.any(np.diff(clock) < 0):
        raise ValueError("expected finite times that never decrease, found a decreasing or non-finite time")
    if n == 0:
        return np.zeros(0, dtype=np.int64)
    first_younger = np.searchsorted(clock, clock - excluded, side="right")
    return np.where(clock - clock[0] < excluded, 0, np.minimum(first_younger + 1, np.arange(n)))


def are_recent(
    n: int,
    times: Float[np.ndarray, " n"] | None,
    now: float | None,
    *,
    seconds: float = EXCLUDED_S,
    frames: int = EXCLUDED_FRAMES,
    rows: Int[np.ndarray, " k"] | None = None,
) -> Bool[np.ndarray, " k"]:
    """Return which of `n` places are too recent to be a revisit: those less than `seconds` old at the time `now`.

    Without times or without `now`, these are the last `frames` places. If `rows` are given, the answer is for these.
    """
    if now is not None and times is not None:
        return (times if rows is None else times[rows]) > now - seconds
    return (np.arange(n) if rows is None else rows) >= n - frames


def has_near(
    queries: Float[np.ndarray, "q d"], database: Float[np.ndarray, "n d"], ends: Int[np.ndarray, " q"], near: Near
) -> Bool[np.ndarray, " q"]:
    """Return whether each query is a revisit: near one of the first `ends` positions of the database."""
    found = np.zeros(len(queries), dtype=bool)
    for start in range(0, len(queries), BLOCK):
        rows = slice(start, start + BLOCK)
        last = ends[rows].max()
        close = near(distances(queries[rows], database[:last]))
        found[rows] = np.any(close & (np.arange(last) < ends[rows, None]), axis=1)
    return found


def revisits(
    positions: Float[np.ndarray, "n d"],
    *,
    times: Float[np.ndarray, " n"] | None = None,
    radius_m: float = POSITIVE_M,
    excluded_s: float = EXCLUDED_S,
    excluded_frames: int = EXCLUDED_FRAMES,
) -> Bool[np.ndarray, " n"]:
    """Return for each frame whether its database (see `database_end`) holds a frame within `radius_m` metres.

    `positions` with three columns give the revisits in 3-D. Their first two columns give those in 2-D.
    """
    ends = database_end(len(positions), times=times, excluded_s=excluded_s, excluded_frames=excluded_frames)
    queries = np.flatnonzero(ends)
    revisited = np.zeros(len(positions), dtype=bool)
    revisited[queries] = has_near(positions[queries], positions, ends[queries], lambda apart: apart <= radius_m)
    return revisited
