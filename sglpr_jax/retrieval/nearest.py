"""Exact nearest neighbours among descriptors, by the distance of their method."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int

from sglpr_jax.retrieval.descriptor_file import DescriptorFile, check_same_method
from sglpr_jax.retrieval.distances import distance_function, smallest
from sglpr_jax.retrieval.index_rows import check_asked
from sglpr_jax.same_place import SAME_PASS_FRAMES

BLOCK = 512
"""Maximum number of queries compared with the whole database at a time."""
PAIRS = 2**26
"""Maximum number of pairs compared at a time, unless the database has more places."""
SHOWN = 10
"""Maximum number of queries in a printed result."""


@dataclass(frozen=True, eq=False)
class Nearest:
    """Nearest k places of every query, nearest first."""

    queries: DescriptorFile
    database: DescriptorFile
    rows: Int[np.ndarray, "q k"]
    """Row of each place in the database; -1 if fewer than k places can be returned."""
    distances: Float32[np.ndarray, "q k"]
    """Descriptor distance of each place; infinite if fewer than k places can be returned."""

    def __len__(self) -> int:
        return len(self.rows)

    def ids(self, query: int | np.integer) -> tuple[str, ...]:
        """Return the names of the places found for a query, nearest first."""
        return tuple(self.database.ids[row] for row in self.rows[query] if row >= 0)

    def __str__(self) -> str:
        """List the queries with the smallest distances, and their nearest places."""
        found = int((self.rows[:, 0] >= 0).sum())
        best = np.argsort(self.distances[:, 0], kind="stable")[: min(SHOWN, found)]
        lines = (f"{self.queries.ids[q]} -> {self.ids(q)[0]}  {self.distances[q, 0]:.4f}" for q in best)
        where = f"{self.queries.sequence} in {self.database.sequence}"
        return "\n".join([f"{found} of {len(self)} queries of {where} have a match; the nearest ones:", *lines])


def nearest(
    queries: DescriptorFile,
    database: DescriptorFile | None = None,
    *,
    k: int = 1,
    exclude_frames: int = SAME_PASS_FRAMES,
    exclude_s: float = 0.0,
) -> Nearest:
    """Find the nearest `k` places of every query by the distance that the descriptor files name.

    Arguments:
      queries: Descriptors of the queries.
      database: Descriptors to search. Without a database, each query is compared with the earlier frames of its own
        recording.
      k: Number of places for each query.
      exclude_frames: Without a database, number of frames before the query that are excluded, because they are no
        revisit.
      exclude_s: Without a database, frames less than this number of seconds old are excluded, too.

    Returns:
      Rows and distances, nearest first. Places with equal distances are in the order of the database.

    Raises:
      ValueError: If the files have different methods or weights, if `k` is below 1, if `k` or all answers exceed the
        bounds of `check_asked`, or if `exclude_s` is set and there are no times.

    Example:
      print(nearest(file))              # places that one recording comes back to
      print(nearest(today, yesterday))  # the places of one session in another
    """
    own, database = database is None, queries if database is None else database
    _check(queries, database, k, exclude_s if own else 0.0)
    compare = distance_function(queries.distance)
    k_there = min(k, len(database))
    rows = np.full((len(queries), k), -1)
    distances = np.full((len(queries), k), np.inf, np.float32)
    step = int(np.clip(PAIRS // len(database), 1, BLOCK))
    for start in range(0, len(queries), step):
        block = np.arange(start, min(start + step, len(queries)))
        found = compare(queries.descriptors[block], database.descriptors)
        if own:
            found = np.where(_old_enough(queries, block, exclude_frames, exclude_s), found, np.float32(np.inf))
        order = smallest(found, k_there)
        distances[block, :k_there] = np.take_along_axis(found, order, axis=1)
        rows[block, :k_there] = np.where(np.isfinite(distances[block, :k_there]), order, -1)
    return Nearest(queries, database, rows, distances)


def _old_enough(
    file: DescriptorFile, block: Int[np.ndarray, " q"], frames: int, seconds: float
) -> Bool[np.ndarray, "q n"]:
    """Which frames are old enough to be answers to the queries `block` of the same recording."""
    allowed = np.arange(len(file))[None, :] < block[:, None] - max(frames, 0)
    if seconds > 0 and file.times is not None:
        allowed &= file.times[block, None] - file.times[None, :] >= seconds
    return allowed


def _check(queries: DescriptorFile, database: DescriptorFile, k: int, seconds: float) -> None:
    check_same_method(queries, database)
    check_asked(k, None, queries=len(queries), places=len(database))
    if seconds > 0 and queries.times is None:
        raise ValueError(f"sequence {queries.sequence}: expected times for excluding recent seconds, found none")
