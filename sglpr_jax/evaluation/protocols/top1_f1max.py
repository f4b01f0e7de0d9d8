"""Protocol of LoGG3D-Net and Locus: F1max of top-1 retrieval."""

from sglpr_jax.evaluation.protocols.answers import score_top1_by_distance
from sglpr_jax.evaluation.protocols.protocol import SCORED_RETRIEVAL, Protocol
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import Source
from sglpr_jax.revisits import Near, database_end
from sglpr_jax.same_place import EXCLUDED_FRAMES, EXCLUDED_S

POSITIVE_M, NEGATIVE_M = 3.0, 20.0
METRES = f"{POSITIVE_M:g} m / {NEGATIVE_M:g} m"


def top1_f1max(source: Source, *, seed: int = 0) -> Result:
    """Score top-1 retrieval as LoGG3D-Net and Locus do: right up to 3 m, wrong beyond 20 m, in 3-D.

    The answer to a query is the nearest descriptor among the frames at least 30 s older. `revisits.database_end` has
    the exact rule. An accepted answer is a true positive up to 3 m away and a false positive beyond 20 m. In between it
    is not counted. A rejected answer is a false negative if the database has a frame within 3 m of the query, else a
    true negative. Every distinct distance is a threshold. The published code uses 1000 thresholds (Locus: 200).
    Published on SemanticKITTI's poses (LoGG3D-Net, evaluation/eval_sequence.py). The interval resamples queries.
    """
    return score_top1(source, "top-1 F1max", f"{METRES}, {excluded(source)}", lambda apart: apart > NEGATIVE_M, seed)


def score_top1(source: Source, name: str, rule: str, wrong: Near, seed: int) -> Result:
    """Score the nearest of the frames at least 30 s older.

    Answers up to 3 m away are right. `wrong` selects the wrong answers.
    """
    result = Result(
        name=name, rule=rule, dimensions=3, pose_source=source.pose_source, published_on="SemanticKITTI's poses"
    )
    ends = database_end(len(source), times=source.times)
    return score_top1_by_distance(source, result, ends, right=lambda apart: apart <= POSITIVE_M, wrong=wrong, seed=seed)


def excluded(source: Source) -> str:
    """Describe the frames that are excluded from the database."""
    return f"last {EXCLUDED_FRAMES} frames excluded" if source.times is None else f"last {EXCLUDED_S:g} s excluded"


TOP1_F1MAX = Protocol(
    "top1-f1max",
    top1_f1max,
    rule="the nearest frame at least 30 s older: right up to 3 m, wrong beyond 20 m, in 3-D",
    source="LoGG3D-Net, evaluation/eval_sequence.py; Locus",
    takes=SCORED_RETRIEVAL,
    returns="F1max",
    headline=True,
)
