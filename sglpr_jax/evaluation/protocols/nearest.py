"""Retrieval of the nearest frames of each query, and the rank of the first right answer."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.evaluation.protocols.source import Source, TopK
from sglpr_jax.retrieval.distances import distance_function, smallest
from sglpr_jax.revisits import Near

BLOCK = 512
"""Number of queries compared with the whole database at a time."""


def nearest_frames(
    source: Source, queries: Int[np.ndarray, " q"], ends: Int[np.ndarray, " q"], *, k: int = 1
) -> tuple[Int[np.ndarray, "q {k}"], Float[np.ndarray, " q"]]:
    """Return the best k of the first `ends` frames for each query, best first, and the distance of the best.

    Rows with fewer than k frames are padded with -1. The distance is infinite for a query without an answer.
    """
    if isinstance(source, TopK):
        return source.lookup(queries, ends, k)
    return nearest_descriptors(source.descriptors[queries], source.descriptors, ends, k=k, distance=source.distance)


def nearest_descriptors(
    queries: Float[np.ndarray, "q d"],
    database: Float[np.ndarray, "n d"],
    ends: Int[np.ndarray, " q"],
    *,
    k: int = 1,
    distance: str = "l2",
) -> tuple[Int[np.ndarray, "q {k}"], Float[np.ndarray, " q"]]:
    """Return the nearest k of the first `ends` >= 1 descriptors for each query, and the distance of the nearest.

    `distance` is a name in `distances.DISTANCES`. Rows with fewer than k descriptors are padded with -1.
    """
    compare = _ranking(database, distance)
    nearest, best = np.full((len(queries), k), -1, dtype=np.int64), np.zeros(len(queries))
    for start in range(0, len(queries), BLOCK):
        rows = slice(start, start + BLOCK)
        ranking = compare(queries[rows])
        ranking[np.arange(len(database)) >= ends[rows, None]] = np.inf
        nearest[rows, : min(k, len(database))] = smallest(ranking, min(k, len(database)))
        best[rows] = np.take_along_axis(ranking, nearest[rows, :1], axis=1)[:, 0]
    if distance == "l2":
        best = np.linalg.norm(queries - database[nearest[:, 0]], axis=1).astype(np.float64)
    return np.where(nearest < ends[:, None], nearest, -1), best


def _ranking(database: Float[np.ndarray, "n d"], distance: str) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function of queries whose values order the database as the named distance does."""
    if distance != "l2":
        compare = distance_function(distance)
        return lambda queries: compare(queries, database)
    # |q - d|^2 without |q|^2, which is constant in a row. In float64, because the terms cancel far from zero.
    exact = database.astype(np.float64)
    norms = np.sum(exact**2, axis=1)
    return lambda queries: norms[None, :] - 2 * queries.astype(np.float64) @ exact.T


def first_hits(
    queries: Float[np.ndarray, "q d"], database: Float[np.ndarray, "n d"], nearest: Int[np.ndarray, "q k"], near: Near
) -> Int[np.ndarray, " q"]:
    """Return for each query the rank, from 0, of the first retrieved frame that is near the query, or k if none is."""
    apart = np.linalg.norm(queries[:, None] - database[nearest], axis=2)
    return first_true(near(apart) & (nearest >= 0))


def first_true(flags: Bool[np.ndarray, "q k"]) -> Int[np.ndarray, " q"]:
    """Return the first true column of each row, or k if no column is true."""
    return np.where(flags.any(axis=1), np.argmax(flags, axis=1), flags.shape[1])
