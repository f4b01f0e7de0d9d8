"""Protocol of Contour Context."""

from sglpr_jax.evaluation.protocols.answers import older_by, score_top1_by_distance
from sglpr_jax.evaluation.protocols.protocol import SCORED_RETRIEVAL, Protocol
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import Source

POSITIVE_M = 5.0
"""Distance below which an answer is right, in metres."""
GAP = 150
"""Frames of the database are more than this number of frames older than the query."""


def contour_context_f1max(source: Source, *, seed: int = 0) -> Result:
    """Score top-1 retrieval as Contour Context does: 5 m in 3-D, a gap of 150 frames.

    The database of frame i is frames 0 to i - 151. An accepted answer is a true positive if it is less than 5 m away,
    else a false positive. A rejected answer is a false negative if the database has a frame less than 5 m away, else a
    true negative. Every distinct score is a threshold. The published code (lewisjiang/contour-context,
    scripts/pr_mpe.py) applies the gap only to false negatives and expects the method to answer with older frames.
    Published on its own file of sensor poses of KITTI 08. The interval resamples queries.
    """
    result = Result(
        name="Contour Context F1max",
        rule=f"{POSITIVE_M:g} m, gap {GAP} frames",
        dimensions=3,
        pose_source=source.pose_source,
        published_on="Contour Context's own sensor poses",
    )
    return score_top1_by_distance(
        source,
        result,
        older_by(len(source), GAP + 1),
        right=lambda apart: apart < POSITIVE_M,
        wrong=lambda apart: apart >= POSITIVE_M,
        seed=seed,
    )


CONTOUR_CONTEXT_F1MAX = Protocol(
    "contour-context-f1max",
    contour_context_f1max,
    rule="the nearest frame more than 150 older: right below 5 m in 3-D, else wrong",
    source="Contour Context, scripts/pr_mpe.py",
    takes=SCORED_RETRIEVAL,
    returns="F1max",
)
