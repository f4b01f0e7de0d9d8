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
"""Function from distances in metres to whether they are within one place, such as `lambda metres: metres < 5`."""


def close_pairs(positions: Float[np.ndarray, "n d"], *, closer_than_m: float) -> Int[np.ndarray, "pairs 2"]:
    """Return every pair of frames less than `closer_than_m` metres apart, each once and in no order."""
    return KDTree(positions).query_pairs(np.nextafter(closer_than_m, 0), output_type="ndarray")


def database_end(n: int, *, times: Float[np.ndarray, " n"] | None = None) -> Int[np.ndarray, " n"]:
    """Return for each of `n` frames the length of its database: the number of first frames that it is compared with.

    0 means that the frame is not a query. The rule is LoGG3D-Net's. A frame in the first 30 s is not a query. The
    database of any other query at time t is frames `[:k + 1]`, where k is the first frame with a time > t - 30 s. So
    one frame of the database is a little younger than 30 s. Without times, the frame number is the clock and 290 frames
    the limit.

    Raises ValueError if times are not finite or decrease.
    """
    clock, excluded = (np.arange(n, dtype=np.float64), EXCLUDED_FRAMES) if times is None else (times, EXCLUDED_S)
    if not np.all(np.isfinite(clock)) or np.any(np.diff(clock) < 0):
        raise ValueError("expected finite times that never decrease, found a decreasing or non-finite time")
    if n == 0:
        return np.zeros(0, dtype=np.int64)
    first_younger = np.searchsorted(clock, clock - excluded, side="right")
    return np.where(clock - clock[0] < excluded, 0, np.minimum(first_younger + 1, np.arange(n)))


def has_near(
    queries: Float[np.ndarray, "q d"], database: Float[np.ndarray, "n d"], ends: Int[np.ndarray, " q"], near: Near
) -> Bool[np.ndarray, " q"]:
    """Return whether each query is a revisit: near one of the first `ends` positions of the database."""
    revisited = np.zeros(len(queries), dtype=bool)
    for start in range(0, len(queries), BLOCK):
        rows = slice(start, start + BLOCK)
        end = ends[rows].max()
        close = near(distances(queries[rows], database[:end]))
        revisited[rows] = np.any(close & (np.arange(end) < ends[rows, None]), axis=1)
    return revisited


def revisits(
    positions: Float[np.ndarray, "n d"], *, times: Float[np.ndarray, " n"] | None = None, radius_m: float = POSITIVE_M
) -> Bool[np.ndarray, " n"]:
    """Return for each frame whether its database (see `database_end`) holds a frame within `radius_m` metres.

    Distances are in 3-D for positions with three columns, in 2-D for those with two.
    """
    ends = database_end(len(positions), times=times)
    queries = np.flatnonzero(ends)
    revisited = np.zeros(len(positions), dtype=bool)
    revisited[queries] = has_near(positions[queries], positions, ends[queries], lambda metres: metres <= radius_m)
    return revisited
