"""Protocol of OverlapTransformer."""

from dataclasses import replace

import numpy as np
from jaxtyping import Int

from sglpr_jax.evaluation.protocols.answers import Answers, older_by, score_answers
from sglpr_jax.evaluation.protocols.nearest import first_true, nearest_frames
from sglpr_jax.evaluation.protocols.pairs import frame_pairs
from sglpr_jax.evaluation.protocols.protocol import SCORED_RETRIEVAL, Protocol
from sglpr_jax.evaluation.protocols.recall import recall_at
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import Source, check_frames, positions_of

GAP = 100
"""Frames of the database are more than this number of frames older than the query."""
FIRST_THRESHOLDED = 150
"""First query of F1max. Queries of Recall@N begin with the first frame that has a database."""
STAND_IN_M = 15.0
"""Distance that replaces missing overlaps, in metres. The same authors use it in CVTNet."""
NUMBERS = (1, 5, 10, 20)


def overlap_transformer_f1max(
    source: Source, overlapping: Int[np.ndarray, "listed 2"] | None = None, *, seed: int = 0
) -> Result:
    """Score top-1 retrieval and Recall@N as OverlapTransformer does: an overlap above 0.3, a gap of 100 frames.

    The database of frame i is frames 0 to i - 101. The last frame is not a query. Queries of F1max begin at frame 150.
    An accepted answer is a true positive if it overlaps with the query, else a false positive. A rejected answer is a
    false negative if the database has an overlapping frame, else a true negative. Every distinct distance is a
    threshold. The published code uses 10,000 thresholds up to a squared distance of 1. Recall@1, 5, 10, 20 and 1 % of
    all frames are over all queries with an overlapping frame. Published on KITTI 00 with overlaps from its poses
    (haomo-ai/OverlapTransformer, test/test_kitti00_PR.py). The interval resamples the queries of F1max.

    Arguments:
      source: Descriptors or a top-k list with scores.
      overlapping: Pairs (query, older frame) whose range images overlap by more than 0.3. If None, frames less than
        15 m apart in x and y replace them. The result is then not the published score.
      seed: Seed of the bootstrap interval.
    """
    n = len(source)
    ends = older_by(n, GAP + 1)
    ends[-1] = 0
    queries = np.flatnonzero(ends)
    overlaps, rule = _overlaps(source, overlapping)
    result = Result(
        name="OverlapTransformer F1max",
        rule=f"{rule}, gap {GAP} frames",
        dimensions=2 if overlapping is None else None,
        pose_source=source.pose_source if overlapping is None else None,
        published_on="overlaps, from KITTI 00's poses",
    )
    revisited = np.isin(queries, overlaps // n)
    numbers = sorted({*NUMBERS, max(round(n / 100), 1)})
    nearest, distance = nearest_frames(source, queries, ends[queries], k=numbers[-1])
    right = np.isin(queries[:, None] * n + nearest, overlaps) & (nearest >= 0)
    if revisited.any():
        result = replace(result, recalls=recall_at(first_true(right)[revisited], numbers))
    late, answered = queries >= FIRST_THRESHOLDED, nearest[:, 0] >= 0
    flags = right[:, 0], ~right[:, 0] & answered, revisited
    answers = Answers(queries[late], nearest[late, 0], distance[late], *(flag[late] for flag in flags))
    return score_answers(source, result, answers, seed=seed)


def _overlaps(source: Source, overlapping: Int[np.ndarray, "listed 2"] | None) -> tuple[Int[np.ndarray, " pairs"], str]:
    """Return the pairs (i, j) of a query and a right answer in its database as i * n + j, and the rule in words."""
    if overlapping is None:
        near = frame_pairs(positions_of(source, 2), lambda apart, gap: (apart < STAND_IN_M) & (gap > GAP))
        return near, f"{STAND_IN_M:g} m in place of overlaps"
    check_frames("overlapping", overlapping, 0, len(source))
    i, j = overlapping[overlapping[:, 0] - overlapping[:, 1] > GAP].T
    return i * len(source) + j, "overlap above 0.3"


OVERLAP_TRANSFORMER_F1MAX = Protocol(
    "overlap-transformer-f1max",
    overlap_transformer_f1max,
    rule="the nearest frame more than 100 older: right where the scans overlap by more than 0.3, else wrong",
    source="OverlapTransformer, test/test_kitti00_PR.py",
    takes=SCORED_RETRIEVAL,
    returns="F1max",
)
