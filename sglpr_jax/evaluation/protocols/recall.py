"""Protocols of recall on one recording: the share of queries with a right answer among their first N answers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.evaluation.protocols.bootstrap import interval, resampled_means
from sglpr_jax.evaluation.protocols.protocol import RETRIEVAL, Decision, Protocol, Result
from sglpr_jax.evaluation.protocols.source import Kind, Source, TopK, first_hits, nearest_frames, positions_of
from sglpr_jax.revisits import has_near

FRAMES = {"00": 4541, "02": 4661, "05": 2761, "06": 1101, "08": 4071}
"""Number of frames of each KITTI sequence. The published splits apply only to recordings of this length."""
SPLITS = {
    "00": (3000, 3200, 4541),
    "02": (3400, 3600, 4661),
    "05": (1000, 1200, 2761),
    "06": (600, 800, 1101),
    "08": (1000, 1200, 4071),
}
"""BEVPlace++: end of the database, start of the queries and end of the queries, by sequence."""
V1_SPLITS = {"00": SPLITS["00"], "02": SPLITS["02"], "05": (1000, 1200, 2751), "06": SPLITS["06"]}
"""BEVPlace: the same without 08 and with ten queries fewer in 05."""
POSITIVE_M = 5.0
"""Distance up to which two frames show the same place, in metres."""
DATABASE_SHARE = 0.6
"""Fraction of the frames that is the database, for recordings without a published split."""
SEAM_M = 20.0
"""Distance between the last frame of the database and the first query, in metres, without a published split.

Closer frames are neighbours, not revisits. The published splits skip 200 frames, which are too many for a short
recording.
"""


@dataclass(frozen=True, kw_only=True)
class SplitRecall(Protocol):
    """Recall@N of BEVPlace: the first part of a recording is the database, a later part the queries.

    A query counts if the database has a frame less than 5 m away. It is found if such a frame is among the first N
    answers. The published split is used if name and number of frames are those of a KITTI sequence with a published
    split. For other recordings the database is the first 60 % of the frames, and the queries begin at the first frame
    20 m from the last frame of the database. The interval of the first recall resamples the queries that count.
    """

    published_on: str = "the poses of BEVPlace's images"
    takes: tuple[Kind, ...] = RETRIEVAL
    paper: str
    """Name of the method that published the splits."""
    splits: Mapping[str, tuple[int, int, int]]
    """End of the database, start of the queries and end of the queries, by sequence."""
    numbers: tuple[int, ...]
    """The numbers N, increasing."""

    def __call__(self, source: Source, *, seed: int = 0) -> Result:
        """Score descriptors or a top-k list. Raises ValueError if positions are missing."""
        positions = positions_of(source, self.dimensions)
        end, first, last, split = self._split(source, positions)
        queries, ends = np.arange(first, last), np.full(last - first, end)
        revisited = has_near(positions[queries], positions, ends, closer_than_5_m)
        ranks = np.full(len(queries), self.numbers[-1])
        if revisited.any():
            nearest, _ = nearest_frames(source, queries, ends, k=self.numbers[-1])
            ranks = first_hits(positions[queries], positions, nearest, closer_than_5_m)
        result = self.result(f"{POSITIVE_M:g} m, {split}", source)
        result = score_recall(result, ranks, revisited, numbers=self.numbers, seed=seed)
        return replace(result, decisions=_decisions(len(source), queries, ranks, revisited))

    def _split(self, source: Source, positions: Float[np.ndarray, "n _"]) -> tuple[int, int, int, str]:
        """Return the end of the database, the start and the end of the queries, and the split in words."""
        n = len(source)
        if source.sequence in self.splits and FRAMES[source.sequence] == n:
            end, first, last = self.splits[source.sequence]
            return end, first, last, f"{self.paper} split: database 0 to {end - 1}, queries {first} to {last - 1}"
        end = max(int(DATABASE_SHARE * n), 1)
        apart = np.linalg.norm(positions[end:] - positions[end - 1], axis=1)
        first = end + int(next(iter(np.flatnonzero(apart >= SEAM_M)), n - end))
        database = f"database is the first {DATABASE_SHARE:.0%} of the frames"
        return end, first, n, f"no published split: {database}, queries begin {SEAM_M:g} m from its end"


BEVPLACE_RECALL_AT_1 = SplitRecall(
    name="bevplace-recall-at-1",
    title="Recall@1",
    rule="Recall@1 of a later part of the recording in its first part: less than 5 m in 3-D",
    source="BEVPlace++, kitti_dataset.py",
    dimensions=3,
    paper="BEVPlace++",
    splits=SPLITS,
    numbers=(1,),
    headline=True,
)
"""The published code (zjuluolun/BEVPlace2) uses every fifth frame of sequence 08; here all frames are used."""
BEVPLACE_V1_RECALL = SplitRecall(
    name="bevplace-v1-recall",
    title="BEVPlace v1 Recall@1",
    rule="Recall@1, 5, 10 and 20 of a later part of the recording in its first part: less than 5 m in x and y",
    source="BEVPlace",
    dimensions=2,
    paper="BEVPlace",
    splits=V1_SPLITS,
    numbers=(1, 5, 10, 20),
)


@dataclass(frozen=True, kw_only=True)
class SscRecall(Protocol):
    """Recall@1 to 25 of SSC and RINet: 5 m in x and y, a gap of 50 frames.

    The database of frame i is frames 0 to i - 51. A frame is a query if its database has a frame at most 5 m away. It
    is found at N if such a frame is among the first N answers. Every row of a top-k list is a query and counts. With
    this rule SSC's own lists give the published numbers, although one or two rows of some sequences have no revisit on
    these poses. The interval of Recall@1 resamples queries.
    """

    gap: int = 50
    numbers: tuple[int, ...] = tuple(range(1, 26))

    def __call__(self, source: Source, *, seed: int = 0) -> Result:
        """Score descriptors or a top-k list. Raises ValueError if positions are missing."""
        positions, n = positions_of(source, self.dimensions), len(source)
        ends = np.maximum(np.arange(n) - self.gap, 0)
        frames = np.flatnonzero(ends)
        revisited = np.zeros(n, dtype=bool)
        revisited[frames] = has_near(positions[frames], positions, ends[frames], up_to_5_m)
        queries = source.queries if isinstance(source, TopK) else np.flatnonzero(revisited)
        ranks = np.zeros(0, dtype=np.int64)
        if len(queries):
            nearest, _ = nearest_frames(source, queries, ends[queries], k=self.numbers[-1])
            ranks = first_hits(positions[queries], positions, nearest, up_to_5_m)
        every_row = ", every row" if isinstance(source, TopK) else ""
        result = self.result(f"{POSITIVE_M:g} m, gap {self.gap} frames{every_row}", source)
        every = np.ones(len(queries), dtype=bool)  # all queries count, even without a revisit
        scored = score_recall(result, ranks, every, numbers=self.numbers, seed=seed)
        counts = {"queries": len(queries), "revisits": int(revisited[queries].sum())}
        return replace(scored, counts=counts, decisions=_decisions(n, queries, ranks, every))


SSC_RECALL = SscRecall(
    name="ssc-recall",
    title="SSC Recall@1",
    rule="Recall@1 to 25: a frame more than 50 older, no farther than 5 m in x and y",
    source="SSC, script/recall.py; RINet",
    published_on="SemanticKITTI's poses",
    dimensions=2,
    takes=RETRIEVAL,
)


def closer_than_5_m(apart: Float[np.ndarray, "..."]) -> Bool[np.ndarray, "..."]:
    """Return whether frames at these distances, in metres, show the same place according to BEVPlace."""
    return apart < POSITIVE_M


def up_to_5_m(apart: Float[np.ndarray, "..."]) -> Bool[np.ndarray, "..."]:
    """Return whether frames at these distances, in metres, show the same place according to SSC."""
    return apart <= POSITIVE_M


def recall_at(ranks: Int[np.ndarray, " q"], numbers: Sequence[int]) -> dict[int, float]:
    """Return Recall@N for each N, given the rank (from 0) of the first right answer of each query."""
    return {n: float(np.mean(ranks < n)) for n in numbers}


def score_recall(
    result: Result,
    ranks: Int[np.ndarray, " q"],
    revisited: Bool[np.ndarray, " q"],
    *,
    numbers: Sequence[int] = (1,),
    seed: int,
) -> Result:
    """Complete `result` with counts and, if there is a revisit, with recalls. The score is the first recall.

    Only queries that are `revisited` count.
    """
    result = replace(result, counts={"queries": len(ranks), "revisits": int(revisited.sum())})
    if not revisited.any():
        return result
    found = ranks[revisited] < numbers[0]
    recalls = recall_at(ranks[revisited], numbers)
    bounds = interval(resampled_means(found, np.random.default_rng(seed)))
    return replace(result, score=recalls[numbers[0]], recalls=recalls, interval=bounds)


def _decisions(
    n: int, queries: Int[np.ndarray, " q"], ranks: Int[np.ndarray, " q"], revisited: Bool[np.ndarray, " q"]
) -> np.ndarray:
    """Return the `Decision` of each frame by its first answer, (n,) int8. Queries without a revisit are not counted."""
    decisions = np.full(n, Decision.NOT_A_QUERY, dtype=np.int8)
    found = np.where(ranks == 0, Decision.TRUE_POSITIVE, Decision.FALSE_NEGATIVE)
    decisions[queries] = np.where(revisited, found, Decision.UNCOUNTED)
    return decisions
