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
from sglpr_jax.se3 import lengths_along

SPLITS = {
    "00": (3000, 3200, 4541),
    "02": (3400, 3600, 4661),
    "05": (1000, 1200, 2761),
    "06": (600, 800, 1101),
    "08": (1000, 1200, 4071),
}
"""Splits of BEVPlace++ by KITTI sequence: end of the database, start and end of the queries, as frame numbers. The end
of the queries is the end of the sequence."""
V1_SPLITS = {"00": SPLITS["00"], "02": SPLITS["02"], "05": (1000, 1200, 2751), "06": SPLITS["06"]}
"""Splits of BEVPlace: those of BEVPlace++ without 08, and with ten queries fewer in 05."""
DATABASE_SHARE = 0.6
"""Fraction of the travelled distance that is the database, for recordings without a published split."""
SEAM_M = 20.0
"""Distance between the last frame of the database and the first query in metres, without a published split. Published
splits skip 200 frames (neighbours, not revisits), which are too many for a short recording."""
GAP = 50
"""The database of frame i is frames 0 to i - 51 in SSC's recall."""

Split = tuple[Int[np.ndarray, " q"], Int[np.ndarray, " q"], str]
"""Query frames, the end of the database of each query (frames 0 to end - 1), and the rule in words."""


@dataclass(frozen=True, kw_only=True)
class Recall(Protocol):
    """Recall@N on one recording. The score and its bootstrap interval are those of the first of `numbers`.

    Recall@N is the share of counted queries with a near frame among their first N answers. A query is a revisit if its
    database has a near frame. By default only revisits are counted.
    """

    takes: tuple[Kind, ...] = ("descriptors", "top-k list", "scored top-k list")
    metres: str = "5 m"
    """Distance of right answers, as stated in results."""
    near: Near = lambda metres: metres < 5
    """Whether an answer at this distance in metres is right."""
    split: Callable[[Source, Float[np.ndarray, "n _"]], Split]
    """Selects the queries, given a source and its positions in metres."""
    every_query_counts: bool = False
    """Whether queries that are no revisits are counted, too. They are always missed."""
    numbers: tuple[int, ...] = (1,)
    """The numbers N, increasing."""

    def __call__(self, source: Source, *, seed: int = 0) -> Result:
        """Score descriptors or a top-k list. Raises ValueError if positions are missing."""
        positions = positions_of(source, self.dimensions)
        queries, ends, split = self.split(source, positions)
        revisited = has_near(positions[queries], positions, ends, self.near)
        nearest, _ = nearest_frames(source, queries, ends, k=self.numbers[-1])
        right = near_answers(positions[queries], positions, nearest, self.near)
        counted = np.ones_like(revisited) if self.every_query_counts else revisited
        decisions = np.full(len(source), Decision.NOT_A_QUERY, dtype=np.int8)
        first_answer = np.where(right[:, 0], Decision.TRUE_POSITIVE, Decision.FALSE_NEGATIVE)
        decisions[queries] = np.where(counted, first_answer, Decision.UNCOUNTED)
        counts = {"queries": len(queries), "revisits": int(revisited.sum())}
        result = replace(self.new_result(f"{self.metres}, {split}", source), counts=counts, decisions=decisions)
        if not counted.any():
            return result
        n = self.numbers[0]
        recalls = recall_at(right[counted], self.numbers)
        answered = np.asarray(right[counted, :n].any(axis=1))
        interval = percentile_interval(resampled_means(answered, np.random.default_rng(seed)))
        return replace(result, score=recalls[n], recalls=recalls, interval=interval)


def _published_split(
    source: Source, positions: Float[np.ndarray, "n _"], *, paper: str, splits: Mapping[str, tuple[int, int, int]]
) -> Split:
    """Return a split like BEVPlace's: the first frames of a recording are the database, and later frames are queries.

    `splits` are used for recordings with the name and number of frames of a KITTI sequence. For other recordings the
    database is the first 60 % of the travelled distance, and the first query is the first frame 20 m from its end.
    """
    n = len(source)
    if source.sequence in splits and SPLITS[source.sequence][2] == n:
        database_end, first_query, queries_end = splits[source.sequence]
        rule = f"{paper} split: database 0 to {database_end - 1}, queries {first_query} to {queries_end - 1}"
    else:
        length_m, queries_end = lengths_along(positions), n
        database_end = max(int(np.searchsorted(length_m, DATABASE_SHARE * length_m[-1])), 1)
        metres = np.linalg.norm(positions[database_end:] - positions[database_end - 1], axis=1)
        is_far = metres >= SEAM_M
        first_query = database_end + int(is_far.argmax()) if is_far.any() else n
        database = f"database is the first {DATABASE_SHARE:.0%} of the path"
        rule = f"no published split: {database}, queries begin {SEAM_M:g} m from its end"
    return np.arange(first_query, queries_end), np.full(queries_end - first_query, database_end), rule


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


def _up_to_5_m(metres: Float[np.ndarray, "..."]) -> np.ndarray:
    return metres <= 5


def _ssc_split(source: Source, positions: Float[np.ndarray, "n _"]) -> Split:
    """Return SSC's split: the frames more than 50 older are the database; queries are the revisits or a list's queries.

    With every listed query, SSC's own lists give the published scores, although a few of them are no revisits here.
    """
    ends = np.maximum(np.arange(len(source)) - GAP, 0)
    if isinstance(source, TopK):
        return source.queries, ends[source.queries], f"gap {GAP} frames, every row"
    frames = np.flatnonzero(ends)  # the first frames have no database
    is_revisit = has_near(positions[frames], positions, ends[frames], _up_to_5_m)
    queries = frames[is_revisit]
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
    """Recall of query sessions in database sessions: all frames of one are the database, all of another the queries.

    Only revisits count: queries with a near frame in the database. With `every_pair`, each session is the database of
    each other session, and the score and the recalls are means over these ordered pairs, without the pairs that have no
    revisit. Otherwise the first of two sessions is the database. The bootstrap interval resamples the revisits.
    """

    takes: tuple[Kind, ...] = ("sessions",)
    dimensions: Literal[2, 3] = 2
    metres: float
    near: Near
    """Whether an answer at this distance is right: up to `metres`."""
    neighbours: int = 1
    """Number of retrieved frames. The score is the recall of the first 1 % of the database, up to this number."""
    every_pair: bool = False
    """Whether every ordered pair of sessions is scored. Otherwise the first is the database of the second."""

    def __call__(self, *sessions: DescriptorFile, seed: int = 0) -> Result:
        """Score two or more sessions. Raises ValueError for fewer, or for descriptors of different methods."""
        if len(sessions) < 2:
            raise ValueError(f"expected at least two sessions, found {len(sessions)}")
        pairs = list(itertools.permutations(sessions, 2)) if self.every_pair else [sessions]
        revisits = 0
        recalls, answered = [], []  # of each pair with a revisit
        for database, queries in pairs:
            check_same_method(database, queries)
            database_xy, query_xy = positions_of(database, 2), positions_of(queries, 2)
            ends = np.full(len(query_xy), len(database_xy))  # every query is compared with the whole database
            nearest, _ = nearest_descriptors(
                queries.descriptors, database.descriptors, ends, k=self.neighbours, distance=database.distance
            )
            revisited = has_near(query_xy, database_xy, ends, self.near)
            right = near_answers(query_xy, database_xy, nearest, self.near)[revisited]
            revisits += len(right)
            if len(right):
                one_percent = max(round(len(database_xy) / 100), 1)
                recalls.append(recall_at(right, range(1, self.neighbours + 1)))
                answered.append(right[:, :one_percent].any(axis=1))
        rule = f"every ordered pair of {len(sessions)} sessions"
        if not self.every_pair:
            rule = f"database {sessions[0].sequence}, queries {sessions[1].sequence}"
        counts = {"session pairs": len(answered)} if self.every_pair else {}
        counts |= {"queries": sum(len(queries) for _, queries in pairs), "revisits": revisits}
        result = replace(self.new_result(f"{self.metres:g} m, {rule}", *sessions), counts=counts)
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
    near=lambda metres: metres < 5,
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
    near=lambda metres: metres <= 25,
    neighbours=25,
    every_pair=True,
)
