"""Protocol of Scan Context's evaluator."""

from sglpr_jax.evaluation.protocols.answers import older_by, score_top1_by_distance
from sglpr_jax.evaluation.protocols.protocol import SCORED_RETRIEVAL, Protocol
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import Source

POSITIVE_M = 5.0
"""Distance below which an answer is right, in metres."""
GAP = 50
"""Number of the last frames, including the query. As in the published code, all but the oldest of them are excluded."""


def scan_context_f1max(source: Source, *, seed: int = 0) -> Result:
    """Score top-1 retrieval as Scan Context's evaluator does: 5 m in x and y.

    The database of frame i is frames 0 to i - 49. The last frame is not a query. An answer is accepted if its
    descriptor distance is at most the threshold. An accepted answer is a true positive
    if it is less than 5 m away, else a false positive. A rejected answer is a false negative if the database has a
    frame less than 5 m away, else a true negative. The published code (gisbi-kim/scancontext, fast_evaluator/main.m)
    compares 50 candidates chosen by ring key, at 100 thresholds. Here all frames are compared and every distinct
    distance is a threshold. The published numbers belong to the pose files of that code, one for each sequence. The
    confidence interval is a bootstrap over queries.
    """
    result = Result(
        name="Scan Context F1max",
        rule=f"{POSITIVE_M:g} m, gap {GAP} frames",
        dimensions=2,
        pose_source=source.pose_source,
        published_on="Scan Context's own pose files",
    )
    ends = older_by(len(source), GAP - 1)
    ends[-1] = 0
    return score_top1_by_distance(
        source, result, ends, right=lambda apart: apart < POSITIVE_M, wrong=lambda apart: apart >= POSITIVE_M, seed=seed
    )


SCAN_CONTEXT_F1MAX = Protocol(
    "scan-context-f1max",
    scan_context_f1max,
    rule="the nearest frame at least 49 older: right below 5 m in x and y, else wrong",
    source="Scan Context, fast_evaluator/main.m",
    takes=SCORED_RETRIEVAL,
    returns="F1max",
)
