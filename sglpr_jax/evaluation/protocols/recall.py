"""Protocols of recall: the share of queries with a right answer among their first N answers."""

import functools
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from sglpr_jax.evaluation.protocols.protocol import (
    Kind,
    Protocol,
    Source,
    TopK,
    near_answers,
    nearest_descriptors,
    nearest_frames,
    positions_of,
    recall_at,
)
from sglpr_jax.evaluation.protocols.result import Decision, Result, percentile_interval, resampled_means
from sglpr_jax.retrieval.descriptor_file import DescriptorFile, check_same_method
from sglpr_jax.revisits import Near, has_near

SPLITS = {
    "00": (3000, 3200, 4541),
    "02": (3400, 3600, 4661),
    "05": (1000, 1200, 2761),
    "06": (600, 800, 1101),
    "08": (1000, 1200, 4071),
}
"""BEVPlace++: end of the database, start of the queries and end of the queries, by sequence. The queries end with the
KITTI sequence."""
V1_SPLITS = {"00": SPLITS["00"], "02": SPLITS["02"], "05": (1000, 1200, 2751), "06": SPLITS["06"]}
"""BEVPlace: the same without 08 and with ten queries fewer in 05."""
DATABASE_SHARE = 0.6
"""Fraction of the frames that is the database, for recordings without a published split."""
SEAM_M = 20.0
"""Distance between the last frame of the database and the first query, in metres, without a published split.

Closer frames are neighbours, not revisits. The published splits skip 200 frames, which are too many for a short
recording.
"""
GAP = 50
"""The database of frame i is frames 0 to i - 51 in SSC's recall."""

Split = tuple[Int[np.ndarray, " q"], Int[np.ndarray, " q"], str]
"""Queries of a recording, the number of its first frames that are the database of each query, and the rule in words."""


@dataclass(frozen=True, kw_only=True)
class Recall(Protocol):
    """Recall@N on one recording. The score and its interval, which resamples queries, are of the first N.

    A query counts if its database has a near frame. The answer is right if such a frame is among the first N answers.
    """

    takes: tuple[Kind, ...] = ("descriptors", "top-k list", "scored top-k list")
    near: Near = lambda apart: apart < 5
    split: Callable[[Source, Float[np.ndarray, "n _"]], Split]
    """Selects the queries, given a source and its positions in metres."""
    every_query_counts: bool = False
    """Whether queries without a revisit count, as missed."""
    numbers: tuple[int, ...] = (1,)
    """The numbers N, increasing."""

    def __call__(self, source: Source, *, seed: int = 0) -> Result:
        """Score descriptors or a top-k list. Raises ValueError if positions are missing."""
        positions = positions_of(source, self.dimensions)
        queries, ends, words = self.split(source, positions)
        revisited = has_near(positions[queries], positions, ends, self.near)
        nearest, _ = nearest_frames(source, queries, ends, k=self.numbers[-1])
        hits = near_answers(positions[queries], positions, nearest, self.near)
        counted = np.ones_like(revisited) if self.every_query_counts else revisited
        decisions = np.full(len(source), Decision.NOT_A_QUERY, dtype=np.int8)
        first = np.where(hits[:, 0], Decision.TRUE_POSITIVE, Decision.FALSE_NEGATIVE)
        decisions[queries] = np.where(counted, first, Decision.UNCOUNTED)
        counts = {"queries": len(queries), "revisits": int(revisited.sum())}
        result = replace(self.result(f"5 m, {words}", source), counts=counts, decisions=decisions)
        if not counted.any():
            return result
        n, hits = self.numbers[0], hits[counted]
        recalls = recall_at(hits, self.numbers)
        answered = np.logical_or.reduce(hits[:, :n], axis=1)
        interval = percentile_interval(resampled_means(answered, np.random.default_rng(seed)))
        return replace(result, score=recalls[n], recalls=recalls, interval=interval)


def _published_split(
    source: Source, positions: Float[np.ndarray, "n _"], *, paper: str, splits: Mapping[str, tuple[int, int, int]]
) -> Split:
    """Split of BEVPlace: the first part of a recording is the database, a later part has the queries.

    `splits` apply if name and number of frames are those of a KITTI sequence. For other recordings the database is the
    first 60 % of the frames, and the queries begin at the first frame 20 m from its last frame.
    """
    n = len(source)
    if source.sequence in splits and SPLITS[source.sequence][2] == n:
        end, first, last = splits[source.sequence]
        words = f"{paper} split: database 0 to {end - 1}, queries {first} to {last - 1}"
    else:
        end, last = max(int(DATABASE_SHARE * n), 1), n
        apart = np.linalg.norm(positions[end:] - positions[end - 1], axis=1)
        first = end + int(next(iter(np.flatnonzero(apart >= SEAM_M)), n - end))
        database = f"database is the first {DATABASE_SHARE:.0%} of the frames"
        words = f"no published split: {database}, queries begin {SEAM_M:g} m from its end"
    return np.arange(first, last), np.full(last - first, end), words


BEVPLACE_RECALL_AT_1 = Recall(
    name="bevplace-recall-at-1",
    title="Recall@1",
    rule="Recall@1 of a later part of the recording in its first part: less than 5 m in 3-D",
    source="BEVPlace++, kitti_dataset.py",
    published_on="the poses of BEVPlace's images",
    dimensions=3,
    split=functools.partial(_published_split, paper="BEVPlace++", splits=SPLITS),
    headline=True,
)
"""The published code (zjuluolun/BEVPlace2) uses every fifth frame of sequence 08; here all frames are used."""
BEVPLACE_V1_RECALL = Recall(
    name="bevplace-v1-recall",
    title="BEVPlace v1 Recall@1",
    rule="Recall@1, 5, 10 and 20 of a later part of the recording in its first part: less than 5 m in x and y",
    source="BEVPlace",
    published_on="the poses of BEVPlace's images",
    dimensions=2,
    split=functools.partial(_published_split, paper="BEVPlace", splits=V1_SPLITS),
    numbers=(1, 5, 10, 20),
)


def _up_to_5_m(apart: Float[np.ndarray, "..."]) -> np.ndarray:
    return apart <= 5


def _ssc_split(source: Source, positions: Float[np.ndarray, "n _"]) -> Split:
    """Select the frames with a revisit, or every row of a top-k list.

    With this rule SSC's own lists give the published numbers, although one or two rows of some sequences have no
    revisit on these poses.
    """
    ends = np.maximum(np.arange(len(source)) - GAP, 0)
    if isinstance(source, TopK):
        return source.queries, ends[source.queries], f"gap {GAP} frames, every row"
    frames = np.flatnonzero(ends)
    queries = frames[has_near(positions[frames], positions, ends[frames], _up_to_5_m)]
    return queries, ends[queries], f"gap {GAP} frames"


SSC_RECALL = Recall(
    name="ssc-recall",
    title="SSC Recall@1",
    rule="Recall@1 to 25: a frame more than 50 older, no farther than 5 m in x and y",
    source="SSC, script/recall.py; RINet",
    published_on="SemanticKITTI's poses",
    dimensions=2,
    near=_up_to_5_m,
    split=_ssc_split,
    every_query_counts=True,
    numbers=tuple(range(1, 26)),
)


@dataclass(frozen=True, kw_only=True)
class SessionRecall(Protocol):
    """Recall of sessions in each other: all frames of one are the database, all frames of another are the queries.

    Queries count as in `Recall`. With `every_pair`, score and recalls are means over every ordered pair of sessions
    that has a query that counts. Otherwise the first of two sessions is the database. The interval resamples the
    queries that count, in each pair.
    """

    takes: tuple[Kind, ...] = ("sessions",)
    dimensions: Literal[2, 3] = 2
    metres: float
    near: Near
    neighbours: int = 1
    """Number of retrieved frames."""
    every_pair: bool = False
    """Whether every ordered pair is scored, by Recall@1 %: the first max(round(n / 100), 1) answers, at most
    `neighbours`, for a database of n frames. Otherwise one pair is scored by Recall@1."""

    def __call__(self, *sessions: DescriptorFile, seed: int = 0) -> Result:
        """Score two or more sessions. Raises ValueError for fewer, or for descriptors of different methods."""
        if len(sessions) < 2:
            raise ValueError(f"expected at least two sessions, found {len(sessions)}")
        queries, revisits, recalls, answered = 0, 0, [], []
        for database, other in itertools.permutations(sessions, 2) if self.every_pair else [sessions]:
            check_same_method(database, other)
            there, here = positions_of(database, 2), positions_of(other, 2)
            ends = np.full(len(here), len(there))
            nearest, _ = nearest_descriptors(
                other.descriptors, database.descriptors, ends, k=self.neighbours, distance=database.distance
            )
            hits = near_answers(here, there, nearest, self.near)[has_near(here, there, ends, self.near)]
            queries, revisits = queries + len(here), revisits + len(hits)
            if len(hits):
                recalls.append(recall_at(hits, range(1, self.neighbours + 1)))
                answered.append(hits[:, : max(round(len(there) / 100), 1)].any(axis=1))
        pairs = f"every ordered pair of {len(sessions)} sessions"
        if not self.every_pair:
            pairs = f"database {sessions[0].sequence}, queries {sessions[1].sequence}"
        counts = {"session pairs": len(answered)} if self.every_pair else {}
        counts |= {"queries": queries, "revisits": revisits}
        result = replace(self.result(f"{self.metres:g} m, {pairs}", *sessions), counts=counts)
        if not answered:
            return result
        rng = np.random.default_rng(seed)
        return replace(
            result,
            score=float(np.mean([np.mean(pair) for pair in answered])),
            recalls={n: float(np.mean([recall[n] for recall in recalls])) for n in recalls[0]},
            interval=percentile_interval(np.mean([resampled_means(pair, rng) for pair in answered], axis=0)),
        )


BEVPLACE_NCLT_RECALL = SessionRecall(
    name="bevplace-nclt-recall",
    title="NCLT Recall@1",
    rule="Recall@1 of one session in another: less than 5 m in x and y",
    source="BEVPlace++, nclt_dataset.py",
    published_on="NCLT's ground truth",
    metres=5.0,
    near=lambda apart: apart < 5,
)
"""Published with 2012-01-15 as the database and 2012-02-04, 03-17, 06-15, 09-28, 11-16 and 2013-02-23 as queries. The
frames used there are not published."""
POINTNETVLAD_RECALL = SessionRecall(
    name="pointnetvlad-recall",
    title="PointNetVLAD Recall@1 %",
    rule="Recall@1 % over every ordered pair of sessions: no farther than 25 m in x and y",
    source="PointNetVLAD, evaluate.py; MinkLoc3D",
    published_on="Oxford RobotCar's positions",
    metres=25.0,
    near=lambda apart: apart <= 25,
    neighbours=25,
    every_pair=True,
)
