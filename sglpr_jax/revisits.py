"""Revisits: frames with a nearby frame in their own past or in a database."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from sglpr_jax.same_place import EXCLUDED_FRAMES, EXCLUDED_S, POSITIVE_M

BLOCK_QUERIES = 32
"""Number of queries that are compared with the database at a time, so that the distances fit in the cache."""

Near = Callable[[Float[np.ndarray, "..."]], Bool[np.ndarray, "..."]]
"""Function of distances in metres. It returns whether each is within one place, as in `lambda metres: metres < 5`."""


def close_pairs(positions: Float[np.ndarray, "n d"], *, closer_than_m: float) -> Int[np.ndarray, "pairs 2"]:
    """Return every pair of frames less than `closer_than_m` metres apart, once each, the earlier frame first."""
    largest_m = np.nextafter(closer_than_m, 0)  # because `query_pairs` includes pairs at this distance
    return KDTree(positions).query_pairs(largest_m, output_type="ndarray")


def database_end(n: int, *, times: Float[np.ndarray, " n"] | None = None) -> Int[np.ndarray, " n"]:
    """Return for each of `n` frames the length of its database: the number of first frames that it is compared with.

    0 means that the frame is not a query. The rule is LoGG3D-Net's. A frame in the first 30 s is not a query. The
    database of any other query at time t is frames `[:k + 1]`, where k is the first frame with a time > t - 30 s. So
    one frame of the database is a little younger than 30 s. Without times, frame numbers replace the times, and 290
    frames replace 30 s.

    Raises ValueError if times are not finite or decrease.
    """
    if times is None:
        clock, excluded = np.arange(n, dtype=np.float64), EXCLUDED_FRAMES
    else:
        clock, excluded = times, EXCLUDED_S
    if not np.all(np.isfinite(clock)) or np.any(np.diff(clock) < 0):
        raise ValueError("expected finite times that never decrease, found a decreasing or non-finite time")
    if n == 0:
        return np.zeros(0, dtype=np.int64)
    first_younger = np.searchsorted(clock, clock - excluded, side="right")
    is_query = clock - clock[0] >= excluded
    return np.where(is_query, np.minimum(first_younger + 1, np.arange(n)), 0)


def has_near(
    queries: Float[np.ndarray, "q d"], database: Float[np.ndarray, "n d"], ends: Int[np.ndarray, " q"], near: Near
) -> Bool[np.ndarray, " q"]:
    """Return whether query i is `near` one of the first `ends[i]` positions of the database, and so a revisit."""
    is_revisit = np.zeros(len(queries), dtype=bool)
    for start in range(0, len(queries), BLOCK_QUERIES):
        rows = slice(start, start + BLOCK_QUERIES)
        end = ends[rows].max()
        is_near = near(cdist(queries[rows], database[:end]))
        is_in_database = np.arange(end) < ends[rows, None]
        is_revisit[rows] = np.any(is_near & is_in_database, axis=1)
    return is_revisit


def revisits(
    positions: Float[np.ndarray, "n d"], *, times: Float[np.ndarray, " n"] | None = None, radius_m: float = POSITIVE_M
) -> Bool[np.ndarray, " n"]:
    """Return for each frame whether its database (see `database_end`) holds a frame within `radius_m` metres.

    Distances are in 3-D for positions with three columns, in 2-D for those with two.
    """
    ends = database_end(len(positions), times=times)
    queries = np.flatnonzero(ends)
    is_revisit = np.zeros(len(positions), dtype=bool)
    is_revisit[queries] = has_near(positions[queries], positions, ends[queries], lambda metres: metres <= radius_m)
    return is_revisit
