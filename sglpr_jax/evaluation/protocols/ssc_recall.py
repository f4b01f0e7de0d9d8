"""Protocol of SSC and RINet: Recall@N."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from sglpr_jax.evaluation.protocols.answers import older_by
from sglpr_jax.evaluation.protocols.nearest import first_hits, nearest_frames
from sglpr_jax.evaluation.protocols.pairs_f1max import GAP
from sglpr_jax.evaluation.protocols.protocol import RETRIEVAL, Protocol
from sglpr_jax.evaluation.protocols.recall import recall_decisions, score_recall
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import Source, TopK, positions_of
from sglpr_jax.revisits import has_near

RECALL_M = 5.0
"""Largest distance at which two frames show the same place, in metres."""
NUMBERS = tuple(range(1, 26))


def ssc_recall(source: Source, *, seed: int = 0) -> Result:
    """Score Recall@1 to 25 as SSC and RINet do: 5 m in x and y, a gap of 50 frames.

    The database of frame i is frames 0 to i - 51. A frame is a query if its database has a frame at most 5 m away. It
    is found at N if such a frame is among the first N answers. Every row of a top-k list is a query and counts. With
    this rule SSC's own lists give the published numbers, although one or two rows of some sequences have no revisit on
    these poses. Published on SemanticKITTI's poses (lilin-hitcrt/SSC, script/recall.py). The interval of Recall@1
    resamples queries.
    """
    positions = positions_of(source, 2)
    ends = older_by(len(source), GAP + 1)
    frames = np.flatnonzero(ends)
    revisited = np.zeros(len(source), dtype=bool)
    revisited[frames] = has_near(positions[frames], positions, ends[frames], _near)
    queries = source.queries if isinstance(source, TopK) else np.flatnonzero(revisited)
    result = Result(
        name="SSC Recall@1",
        rule=f"{RECALL_M:g} m, gap {GAP} frames" + (", every row" if isinstance(source, TopK) else ""),
        dimensions=2,
        pose_source=source.pose_source,
        published_on="SemanticKITTI's poses",
    )
    ranks = np.zeros(0, dtype=np.int64)
    if len(queries):
        nearest, _ = nearest_frames(source, queries, ends[queries], k=NUMBERS[-1])
        ranks = first_hits(positions[queries], positions, nearest, _near)
    return _count(source, result, queries, ranks, revisited[queries], seed)


def _count(
    source: Source,
    result: Result,
    queries: Int[np.ndarray, " q"],
    ranks: Int[np.ndarray, " q"],
    revisited: Bool[np.ndarray, " q"],
    seed: int,
) -> Result:
    """Complete `result`. All queries count, even without a revisit."""
    every = np.ones(len(queries), dtype=bool)
    scored = score_recall(result, ranks, every, numbers=NUMBERS, seed=seed)
    counts = {"queries": len(queries), "revisits": int(revisited.sum())}
    return replace(scored, counts=counts, decisions=recall_decisions(len(source), queries, ranks, every))


def _near(apart: np.ndarray) -> np.ndarray:
    return apart <= RECALL_M


SSC_RECALL = Protocol(
    "ssc-recall",
    ssc_recall,
    rule="Recall@1 to 25: a frame more than 50 older, no farther than 5 m in x and y",
    source="SSC, script/recall.py; RINet",
    takes=RETRIEVAL,
    returns="recall",
)
