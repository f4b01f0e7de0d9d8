"""Protocol of LoGG3D-Net and Locus in which every accepted answer counts."""

from sglpr_jax.evaluation.protocols.protocol import SCORED_RETRIEVAL, Protocol
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import Source
from sglpr_jax.evaluation.protocols.top1_f1max import METRES, POSITIVE_M, excluded, score_top1


def top1_strict_f1max(source: Source, *, seed: int = 0) -> Result:
    """Score top-1 retrieval as `top1_f1max`, except that accepted answers 3 to 20 m away are false positives.

    Every accepted answer counts, so answers that are slightly too far away lower the score. No paper uses this
    protocol. The difference from `top1_f1max` shows the effect of these answers. The interval resamples queries.
    """
    rule = f"{METRES}, in between false, {excluded(source)}"
    return score_top1(source, "top-1 strict F1max", rule, lambda apart: apart > POSITIVE_M, seed)


TOP1_STRICT_F1MAX = Protocol(
    "top1-strict-f1max",
    top1_strict_f1max,
    rule="as top1-f1max, but an answer 3 to 20 m away is wrong too",
    source="this project",
    takes=SCORED_RETRIEVAL,
    returns="F1max",
)
