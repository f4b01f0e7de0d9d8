"""What a method hands in: descriptors, frames that it retrieved, or pairs that it scored."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.retrieval.descriptor_file import DescriptorFile


@dataclass(frozen=True, eq=False)
class TopK:
    """A top-k list: for some frames of a sequence, the frames that a method retrieved for them, best first.

    A frame that is not listed has no answer: where it is a query, it is missed. Raises ValueError where a frame is out
    of range or listed twice, numbers of rows differ, or a value is not finite.
    """

    sequence: str
    positions: Float[np.ndarray, "_n 3"]
    """Metres, z up, of every frame."""
    times: Float[np.ndarray, "_n"] | None
    """Seconds, or None."""
    pose_source: str | None
    queries: Int[np.ndarray, "_q"]
    """The frames listed."""
    nearest: Int[np.ndarray, "_q _k"]
    """The frames retrieved; -1 fills a row that has fewer."""
    scores: Float[np.ndarray, "_q _k"] | None = None
    """Higher is closer. F1max cannot be had without."""

    def __post_init__(self):
        if len(self.queries) == 0:
            raise ValueError("expected a list with at least one query, found none")
        if self.positions.shape != (len(self), 3) or not np.isfinite(self.positions).all():
            raise ValueError(f"expected finite positions (n, 3), found others in {self.positions.shape}")
        if self.times is not None and self.times.shape != (len(self),):
            raise ValueError(f"expected {len(self)} times, one for each position, found {self.times.shape}")
        if self.nearest.ndim != 2 or len(self.nearest) != len(self.queries) or self.nearest.shape[1] == 0:
            raise ValueError(f"expected {len(self.queries)} rows of retrieved frames, found {self.nearest.shape}")
        check_frames("query", self.queries, 0, len(self))
        check_frames("retrieved", self.nearest, -1, len(self))
        if len(np.unique(self.queries)) < len(self.queries):
            raise ValueError("expected every query once, found one listed twice")
        if self.scores is not None and (
            self.scores.shape != self.nearest.shape or not np.isfinite(self.scores[self.nearest >= 0]).all()
        ):
            raise ValueError("expected a finite score for every retrieved frame, found others")

    def __len__(self) -> int:
        return len(self.positions)

    def lookup(
        self, queries: Int[np.ndarray, " q"], ends: Int[np.ndarray, " q"], k: int
    ) -> tuple[Int[np.ndarray, "q {k}"], Float[np.ndarray, " q"]]:
        """Return what `nearest.nearest_frames` returns. Listed frames outside a query's database are passed over."""
        row = np.full(len(self), -1)
        row[self.queries] = np.arange(len(self.queries))
        row = row[queries]
        allowed = (row >= 0)[:, None] & (self.nearest[row] >= 0) & (self.nearest[row] < ends[:, None])
        order = np.argsort(~allowed, axis=1, kind="stable")
        nearest = np.take_along_axis(np.where(allowed, self.nearest[row], -1), order, axis=1)[:, :k]
        distance = np.full(len(queries), np.inf)
        if self.scores is not None:
            best = np.take_along_axis(self.scores[row], order[:, :1], axis=1)[:, 0]
            distance = np.where(nearest[:, 0] >= 0, -best, np.inf)
        return np.pad(nearest, ((0, 0), (0, k - nearest.shape[1])), constant_values=-1), distance


@dataclass(frozen=True, eq=False)
class ScoredPairs:
    """Pairs of frames of a sequence, each with a score and perhaps a label.

    Raises ValueError where the list is empty, a frame is out of range, or the numbers of rows differ.
    """

    pairs: Int[np.ndarray, "_p 2"]
    """Two frames, the query first."""
    scores: Float[np.ndarray, "_p"]
    """Higher is closer."""
    labels: Bool[np.ndarray, "_p"] | None = None
    """One place or not. None: the positions tell."""
    positions: Float[np.ndarray, "_n 3"] | None = None
    """Metres, z up, of every frame. Needed where there are no labels."""
    pose_source: str | None = None

    def __post_init__(self):
        p = len(self.pairs)
        if p == 0:
            raise ValueError("expected a list with at least one pair, found none")
        if self.pairs.shape != (p, 2) or len(self.scores) != p or (self.labels is not None and len(self.labels) != p):
            raise ValueError(f"expected {p} pairs of frames, with a score each and a label each or none, found others")
        if self.labels is None and self.positions is None:
            raise ValueError("expected labels, or positions to tell them from, found neither")
        n = np.iinfo(np.int64).max if self.positions is None else len(self.positions)
        check_frames("pairs of", self.pairs, 0, n)


Source = DescriptorFile | TopK


def positions_of(source: Source, dimensions: int = 3) -> Float[np.ndarray, "n {dimensions}"]:
    """Return the positions, in x and y alone for 2 dimensions; ValueError where there are none."""
    if source.positions is None:
        raise ValueError(f"expected positions to score sequence {source.sequence} against, found none")
    return source.positions[:, :dimensions]


def check_frames(what: str, frames: Int[np.ndarray, "..."], first: int, n: int) -> None:
    """Raise ValueError unless all frames are `first` to n - 1, naming the first row in which one is not."""
    outside = np.argwhere((frames < first) | (frames >= n))
    if outside.size:
        row = outside[0, 0]
        found = frames[tuple(outside[0])]
        raise ValueError(f"expected {what} frames from {first} to {n - 1}, found {found} in row {row}")


def pose_sources(*files: DescriptorFile) -> str | None:
    """Return every pose source of the files once, as one text; None where none is named."""
    return ", ".join(dict.fromkeys(file.pose_source for file in files if file.pose_source)) or None
