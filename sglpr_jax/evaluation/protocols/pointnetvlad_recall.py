"""Protocol of PointNetVLAD, used on Oxford RobotCar by MinkLoc3D and many others: Recall@1 % across sessions."""

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from sglpr_jax.evaluation.protocols.bootstrap import interval, resampled_means
from sglpr_jax.evaluation.protocols.nearest import first_hits, nearest_descriptors
from sglpr_jax.evaluation.protocols.protocol import Protocol
from sglpr_jax.evaluation.protocols.recall import recall_at
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import pose_sources, positions_of
from sglpr_jax.retrieval.descriptor_file import DescriptorFile, check_same_method
from sglpr_jax.revisits import has_near

POSITIVE_M = 25.0
"""Largest distance at which two frames show the same place, in metres."""
NEIGHBOURS = 25
"""Number of retrieved frames. Recall@1 % uses at most this number, even for larger databases."""


def pointnetvlad_recall(*sessions: DescriptorFile, seed: int = 0) -> Result:
    """Score the mean Recall@1 % over every ordered pair of two or more sessions as PointNetVLAD does: 25 m.

    The first session of a pair is the database, and the second has the queries. A query counts if the database has a
    frame at most 25 m away in x and y. It is found if such a frame is among the first max(round(n / 100), 1) answers,
    at most 25, for a database of n frames. Score and Recall@N are means over the pairs that have a query that counts.
    Published on Oxford RobotCar's positions (mikacuy/pointnetvlad, evaluate.py). The interval resamples the queries
    that count, in each pair.
    """
    if len(sessions) < 2:
        raise ValueError(f"expected at least two sessions, found {len(sessions)}")
    retrieved = [_retrieve(database, queries) for database, queries in itertools.permutations(sessions, 2)]
    result = Result(
        name="PointNetVLAD Recall@1 %",
        rule=f"{POSITIVE_M:g} m, every ordered pair of {len(sessions)} sessions",
        dimensions=2,
        pose_source=pose_sources(*sessions),
        published_on="Oxford RobotCar's positions",
        counts={
            "session pairs": sum(bool(revisited.any()) for _, revisited, _ in retrieved),
            "queries": sum(len(ranks) for ranks, _, _ in retrieved),
            "revisits": sum(int(revisited.sum()) for _, revisited, _ in retrieved),
        },
    )
    answered = [(ranks[revisited], percent) for ranks, revisited, percent in retrieved if revisited.any()]
    return _score(result, answered, seed) if answered else result


def _retrieve(
    database: DescriptorFile, queries: DescriptorFile
) -> tuple[Int[np.ndarray, " q"], Bool[np.ndarray, " q"], int]:
    """Return the rank of each query's first right answer, which queries count, and the number of answers for 1 %."""
    check_same_method(database, queries)
    there, here = positions_of(database, 2), positions_of(queries, 2)
    ends = np.full(len(here), len(there))
    nearest, _ = nearest_descriptors(
        queries.descriptors, database.descriptors, ends, k=NEIGHBOURS, distance=database.distance
    )
    one_percent = min(max(round(len(there) / 100), 1), NEIGHBOURS)
    return first_hits(here, there, nearest, _near), has_near(here, there, ends, _near), one_percent


def _score(result: Result, answered: Sequence[tuple[Int[np.ndarray, " _"], int]], seed: int) -> Result:
    """Complete `result` with means over the pairs of sessions."""
    rng = np.random.default_rng(seed)
    recalls = [recall_at(ranks, range(1, NEIGHBOURS + 1)) for ranks, _ in answered]
    found = [ranks < one_percent for ranks, one_percent in answered]
    return replace(
        result,
        score=float(np.mean([np.mean(pair) for pair in found])),
        recalls={n: float(np.mean([recall[n] for recall in recalls])) for n in recalls[0]},
        interval=interval(np.mean([resampled_means(pair, rng) for pair in found], axis=0)),
    )


def _near(apart: np.ndarray) -> np.ndarray:
    return apart <= POSITIVE_M


POINTNETVLAD_RECALL = Protocol(
    "pointnetvlad-recall",
    pointnetvlad_recall,
    rule="Recall@1 % over every ordered pair of sessions: no farther than 25 m in x and y",
    source="PointNetVLAD, evaluate.py; MinkLoc3D",
    takes=("sessions",),
    returns="recall",
)
