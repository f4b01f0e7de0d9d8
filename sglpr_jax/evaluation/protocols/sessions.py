"""Protocols across sessions: one session is the database, another has the queries."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int

from sglpr_jax.evaluation.protocols.bootstrap import interval, resampled_means
from sglpr_jax.evaluation.protocols.protocol import Protocol, Result
from sglpr_jax.evaluation.protocols.recall import POSITIVE_M, closer_than_5_m, recall_at, score_recall
from sglpr_jax.evaluation.protocols.source import Kind, first_hits, nearest_descriptors, positions_of
from sglpr_jax.retrieval.descriptor_file import DescriptorFile, check_same_method
from sglpr_jax.revisits import Near, has_near


@dataclass(frozen=True, kw_only=True)
class NcltRecall(Protocol):
    """Recall@1 of BEVPlace++ on NCLT: all frames of one session are the database, all of the other are queries.

    A query counts if the database has a frame less than 5 m away. It is found if the frame of the nearest descriptor is
    less than 5 m away. The interval resamples the queries that count.
    """

    takes: tuple[Kind, ...] = ("sessions",)

    def __call__(self, database: DescriptorFile, queries: DescriptorFile, *, seed: int = 0) -> Result:
        """Score one session in another. Raises ValueError for descriptors of different methods."""
        ranks, revisited = _retrieve(database, queries, closer_than_5_m, k=1)
        rule = f"{POSITIVE_M:g} m, database {database.sequence}, queries {queries.sequence}"
        return score_recall(self.result(rule, database, queries), ranks, revisited, seed=seed)


BEVPLACE_NCLT_RECALL = NcltRecall(
    name="bevplace-nclt-recall",
    title="NCLT Recall@1",
    rule="Recall@1 of one session in another: less than 5 m in x and y",
    source="BEVPlace++, nclt_dataset.py",
    published_on="NCLT's ground truth",
    dimensions=2,
)
"""Published with 2012-01-15 as the database and 2012-02-04, 03-17, 06-15, 09-28, 11-16 and 2013-02-23 as queries. The
frames used there are not published."""


@dataclass(frozen=True, kw_only=True)
class PointNetVladRecall(Protocol):
    """Mean Recall@1 % over every ordered pair of two or more sessions.

    The first session of a pair is the database, and the second has the queries. A query counts if the database has a
    frame at most 25 m away in x and y. It is found if such a frame is among the first max(round(n / 100), 1) answers,
    at most 25, for a database of n frames. Score and Recall@N are means over the pairs that have a query that counts.
    The interval resamples the queries that count, in each pair.
    """

    takes: tuple[Kind, ...] = ("sessions",)
    near: Near = lambda apart: apart <= 25
    neighbours: int = 25
    """Number of retrieved frames. Recall@1 % uses at most this number, even for larger databases."""

    def __call__(self, *sessions: DescriptorFile, seed: int = 0) -> Result:
        """Score two or more sessions. Raises ValueError for fewer, or for descriptors of different methods."""
        if len(sessions) < 2:
            raise ValueError(f"expected at least two sessions, found {len(sessions)}")
        rng = np.random.default_rng(seed)
        queries, revisits, recalls, found = 0, 0, [], []
        for database, other in itertools.permutations(sessions, 2):
            ranks, revisited = _retrieve(database, other, self.near, k=self.neighbours)
            queries, revisits = queries + len(ranks), revisits + int(revisited.sum())
            if revisited.any():
                recalls.append(recall_at(ranks[revisited], range(1, self.neighbours + 1)))
                found.append(ranks[revisited] < min(max(round(len(database) / 100), 1), self.neighbours))
        result = self.result(f"25 m, every ordered pair of {len(sessions)} sessions", *sessions)
        result = replace(result, counts={"session pairs": len(found), "queries": queries, "revisits": revisits})
        if not found:
            return result
        return replace(
            result,
            score=float(np.mean([np.mean(pair) for pair in found])),
            recalls={n: float(np.mean([recall[n] for recall in recalls])) for n in recalls[0]},
            interval=interval(np.mean([resampled_means(pair, rng) for pair in found], axis=0)),
        )


POINTNETVLAD_RECALL = PointNetVladRecall(
    name="pointnetvlad-recall",
    title="PointNetVLAD Recall@1 %",
    rule="Recall@1 % over every ordered pair of sessions: no farther than 25 m in x and y",
    source="PointNetVLAD, evaluate.py; MinkLoc3D",
    published_on="Oxford RobotCar's positions",
    dimensions=2,
)


def _retrieve(
    database: DescriptorFile, queries: DescriptorFile, near: Near, *, k: int
) -> tuple[Int[np.ndarray, " q"], Bool[np.ndarray, " q"]]:
    """Return the rank of each query's first right answer among k, and which queries count."""
    check_same_method(database, queries)
    there, here = positions_of(database, 2), positions_of(queries, 2)
    ends = np.full(len(here), len(there))
    nearest, _ = nearest_descriptors(queries.descriptors, database.descriptors, ends, k=k, distance=database.distance)
    return first_hits(here, there, nearest, near), has_near(here, there, ends, near)
