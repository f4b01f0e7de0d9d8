"""Base class of the protocols, their inputs (descriptors, top-k lists, scored pairs), and retrieval in these inputs."""

import abc
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.distances import distance_function, smallest
from sglpr_jax.revisits import Near

Kind = Literal["descriptors", "top-k list", "scored top-k list", "scored pairs", "sessions"]
"""Kind of input: a descriptor file, retrieved frames without or with scores, pairs of frames with scores, or descriptor
files of several sessions. The first session is the database."""
BLOCK = 512
"""Number of queries compared with the whole database at a time."""


@dataclass(frozen=True, eq=False)
class TopK:
    """Top-k list: the frames that a method retrieved for some frames of a sequence, best first.

    A query that is not listed has no answer and counts as missed. Raises ValueError if the list is empty, if a frame is
    out of range, if a query is listed twice, if array shapes do not match, or if a position or score is not finite.
    """

    sequence: str
    """Name of the sequence."""
    positions: Float[np.ndarray, "_n 3"]
    """Position of every frame in metres, z up."""
    times: Float[np.ndarray, "_n"] | None
    """Time of every frame in seconds, or None."""
    pose_source: str | None
    """Source of the poses, in words."""
    queries: Int[np.ndarray, "_q"]
    """Listed query frames."""
    nearest: Int[np.ndarray, "_q _k"]
    """Retrieved frames of each query. Shorter rows are padded with -1."""
    scores: Float[np.ndarray, "_q _k"] | None = None
    """Score of each retrieved frame. Higher means closer. F1max needs scores."""

    def __post_init__(self):
        q = len(self.queries)
        if q == 0:
            raise ValueError("expected a list with at least one query, found none")
        if self.positions.shape != (len(self), 3) or not np.isfinite(self.positions).all():
            raise ValueError(
                f"expected finite positions (n, 3), found shape {self.positions.shape} or non-finite values"
            )
        if self.times is not None and self.times.shape != (len(self),):
            raise ValueError(f"expected {len(self)} times, one for each position, found shape {self.times.shape}")
        if self.nearest.ndim != 2 or len(self.nearest) != q or self.nearest.shape[1] == 0:
            raise ValueError(f"expected retrieved frames of shape ({q}, k >= 1), found shape {self.nearest.shape}")
        _check_frames("query", self.queries, 0, len(self))
        _check_frames("retrieved", self.nearest, -1, len(self))
        if len(np.unique(self.queries)) < q:
            raise ValueError("expected every query once, found one listed twice")
        if self.scores is not None and (
            self.scores.shape != self.nearest.shape or not np.isfinite(self.scores[self.nearest >= 0]).all()
        ):
            raise ValueError("expected a finite score for every retrieved frame, found missing or non-finite scores")

    def __len__(self) -> int:
        return len(self.positions)

    def lookup(
        self, queries: Int[np.ndarray, " q"], ends: Int[np.ndarray, " q"], k: int
    ) -> tuple[Int[np.ndarray, "q {k}"], Float[np.ndarray, " q"]]:
        """Return the first k listed frames below `ends` for each query, and the negated score of the first frame.

        Rows with fewer than k frames are padded with -1. The score is infinite without an answer or without scores.
        """
        list_row_of_frame = np.full(len(self), -1)
        list_row_of_frame[self.queries] = np.arange(len(self.queries))
        list_row = list_row_of_frame[queries]  # -1: the query is not listed
        listed = self.nearest[list_row]
        allowed = (list_row >= 0)[:, None] & (listed >= 0) & (listed < ends[:, None])
        allowed_first = np.argsort(~allowed, axis=1, kind="stable")
        nearest = np.take_along_axis(np.where(allowed, listed, -1), allowed_first, axis=1)[:, :k]
        distance = np.full(len(queries), np.inf)
        if self.scores is not None:
            best_score = np.take_along_axis(self.scores[list_row], allowed_first[:, :1], axis=1)[:, 0]
            distance = np.where(nearest[:, 0] >= 0, -best_score, np.inf)
        return np.pad(nearest, ((0, 0), (0, k - nearest.shape[1])), constant_values=-1), distance


@dataclass(frozen=True, eq=False)
class ScoredPairs:
    """Pairs of frames of a sequence with scores, and with labels or positions.

    Raises ValueError if the list is empty, if a frame is out of range, or if numbers of rows differ.
    """

    pairs: Int[np.ndarray, "_p 2"]
    """Frames of each pair, the query first."""
    scores: Float[np.ndarray, "_p"]
    """Score of each pair. Higher means closer."""
    labels: Bool[np.ndarray, "_p"] | None = None
    """Whether the frames of each pair show the same place. If None, labels are computed from the positions."""
    positions: Float[np.ndarray, "_n 3"] | None = None
    """Position of every frame in metres, z up. Required without labels."""
    pose_source: str | None = None
    """Source of the poses, in words."""
    sequence: str = "scored pairs"
    """Name of the sequence."""

    def __post_init__(self):
        p = len(self.pairs)
        if p == 0:
            raise ValueError("expected a list with at least one pair, found none")
        if self.pairs.shape != (p, 2) or len(self.scores) != p or (self.labels is not None and len(self.labels) != p):
            labels = "no" if self.labels is None else len(self.labels)
            found = f"pairs of shape {self.pairs.shape}, {len(self.scores)} scores, {labels} labels"
            raise ValueError(f"expected {p} pairs of frames with {p} scores, and {p} labels or none; found {found}")
        if self.labels is None and self.positions is None:
            raise ValueError("expected labels, or positions to compute them from, found neither")
        n = np.iinfo(np.int64).max if self.positions is None else len(self.positions)  # without positions: any number
        _check_frames("pairs of", self.pairs, 0, n)


Source = DescriptorFile | TopK
Input = Source | ScoredPairs


def kind_of(source: Input) -> Kind:
    """Return the kind of an input of one recording, by which a protocol says that it can score the input."""
    if isinstance(source, ScoredPairs):
        return "scored pairs"
    if isinstance(source, TopK):
        return "top-k list" if source.scores is None else "scored top-k list"
    return "descriptors"


def _check_frames(what: str, frames: Int[np.ndarray, "..."], first: int, n: int) -> None:
    """Raise ValueError with the first row that has a frame number outside `first` to n - 1."""
    outside = np.argwhere((frames < first) | (frames >= n))
    if len(outside):
        index = tuple(outside[0])
        raise ValueError(f"expected {what} frames from {first} to {n - 1}, found {frames[index]} in row {index[0]}")


@dataclass(frozen=True, kw_only=True)
class Protocol(abc.ABC):
    """Rule for scoring a method. A subclass computes the score; an instance has the distances of one paper."""

    name: str
    """Name on the command line."""
    title: str
    """Name of the results in tables."""
    rule: str
    """Rule in words: which answers are right and what is counted."""
    source: str
    """Publication, with the file of its code that defines the rule."""
    published_on: str
    """Poses with which the published scores were computed."""
    dimensions: Literal[2, 3]
    """Dimensions of distances between frames: 2 for x and y, 3 for x, y and z."""
    takes: tuple[Kind, ...]
    """Kinds of input that the protocol accepts."""
    headline: bool = False
    """Whether the protocol is used by default, if no protocol is named."""

    @abc.abstractmethod
    def __call__(self, *sources: Input, seed: int = 0) -> Result:
        """Score a source or sessions. `seed` draws pairs and resamples. Raises ValueError if positions are missing."""

    def new_result(self, rule: str, *sources: Input) -> Result:
        """Return a result without a score yet. `rule` describes the distances, such as "3 m / 20 m, all negatives"."""
        poses = ", ".join(dict.fromkeys(source.pose_source for source in sources if source.pose_source)) or None
        return Result(self.title, rule, self.dimensions, poses, self.published_on)


def positions_of(source: Source, dimensions: int = 3) -> Float[np.ndarray, "n {dimensions}"]:
    """Return the positions, only x and y for 2 dimensions. Raises ValueError if positions are missing."""
    if source.positions is None:
        raise ValueError(f"expected positions to score sequence {source.sequence} against, found none")
    return source.positions[:, :dimensions]


def nearest_frames(
    source: Source, queries: Int[np.ndarray, " q"], ends: Int[np.ndarray, " q"], *, k: int = 1
) -> tuple[Int[np.ndarray, "q {k}"], Float[np.ndarray, " q"]]:
    """Return the best k frames for each query, best first, and the distance of the best frame.

    Query i may only be answered with the frames 0 to ends[i] - 1. Rows with fewer than k frames are padded with -1. The
    distance is infinite for a query without an answer.
    """
    if isinstance(source, TopK):
        return source.lookup(queries, ends, k)
    return nearest_descriptors(source.descriptors[queries], source.descriptors, ends, k=k, distance=source.distance)


def nearest_descriptors(
    queries: Float[np.ndarray, "q d"],
    database: Float[np.ndarray, "n d"],
    ends: Int[np.ndarray, " q"],
    *,
    k: int,
    distance: str,
) -> tuple[Int[np.ndarray, "q {k}"], Float[np.ndarray, " q"]]:
    """Return the rows of the nearest k descriptors for each query, nearest first, and the distance of the nearest.

    Query i is compared with the first ends[i] >= 1 rows of the database. `distance` is a name in `distances.DISTANCES`.
    Rows of the result with fewer than k descriptors are padded with -1.
    """
    nearest = np.full((len(queries), k), -1, dtype=np.int64)
    nearest_distance = np.zeros(len(queries))
    database_f64 = database.astype(np.float64)
    squared_norms = np.sum(database_f64**2, axis=1)
    compare = distance_function(distance)
    columns = min(k, len(database))
    for start in range(0, len(queries), BLOCK):
        block = slice(start, start + BLOCK)
        if distance == "l2":
            # |q - d|^2 - |q|^2 ranks as |q - d| does. In float64, because the terms nearly cancel for large values.
            ranking = squared_norms[None, :] - 2 * queries[block].astype(np.float64) @ database_f64.T
        else:
            ranking = compare(queries[block], database)
        ranking[np.arange(len(database)) >= ends[block, None]] = np.inf
        nearest[block, :columns] = smallest(ranking, columns)
        nearest_distance[block] = np.take_along_axis(ranking, nearest[block, :1], axis=1)[:, 0]
    if distance == "l2":
        nearest_distance = np.linalg.norm(queries - database[nearest[:, 0]], axis=1).astype(np.float64)
    return np.where(nearest < ends[:, None], nearest, -1), nearest_distance


def near_answers(
    queries: Float[np.ndarray, "q d"], database: Float[np.ndarray, "n d"], nearest: Int[np.ndarray, "q k"], near: Near
) -> Bool[np.ndarray, "q k"]:
    """Return whether each retrieved frame is near its query, by positions in metres. Padding (-1) is not near."""
    metres = np.linalg.norm(queries[:, None] - database[nearest], axis=2)
    return near(metres) & (nearest >= 0)


def recall_at(hits: Bool[np.ndarray, "q k"], numbers: Iterable[int]) -> dict[int, float]:
    """Return Recall@N for each N: the share of queries with a right answer among the first N of their k answers."""
    return {n: float(np.mean(hits[:, :n].any(axis=1))) for n in numbers}
