"""The protocol of LoGG3D-Net and Locus, and its strict variant."""

from sglpr_jax.evaluation.protocols.nearest import Near
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import Source
from sglpr_jax.evaluation.protocols.top1 import score_top1_by_distance
from sglpr_jax.poses import EXCLUDED_FRAMES, EXCLUDED_S, NEGATIVE_M, POSITIVE_M, database_end


def top1_f1max(source: Source, *, seed: int = 0) -> Result:
    """Score top-1 retrieval as LoGG3D-Net and Locus do: 3 m / 20 m in 3-D, the last 30 s excluded.

    Each query is answered with the nearest descriptor among the frames at least 30 s older (`poses.database_end` has
    the rule). Accepted, the answer is a true positive up to 3 m away, a false positive beyond 20 m, and counts for
    nothing in between. Rejected, it is a false negative if the query has any frame within 3 m in its database, else a
    true negative. Every distinct distance is a threshold; the published code takes 1000 of them (Locus: 200).
    Published on SemanticKITTI's poses (LoGG3D-Net, evaluation/eval_sequence.py). The interval resamples queries.
    """
    return _top1(source, "top-1 F1max", f"{_metres()}, {_excluded(source)}", lambda apart: apart > NEGATIVE_M, seed)


def top1_strict_f1max(source: Source, *, seed: int = 0) -> Result:
    """Score top-1 retrieval like `top1_f1max`, but an accepted answer 3 to 20 m away is a false positive too.

    It leaves no answer uncounted, so a method cannot win by near misses. Nobody publishes it; its number beside
    that of `top1_f1max` says how much of the latter rests on them. The interval resamples queries.
    """
    rule = f"{_metres()}, in between false, {_excluded(source)}"
    return _top1(source, "top-1 strict F1max", rule, lambda apart: apart > POSITIVE_M, seed)


def _top1(source: Source, name: str, rule: str, wrong: Near, seed: int) -> Result:
    result = Result(
        name=name, rule=rule, dimensions=3, pose_source=source.pose_source, published_on="SemanticKITTI's poses"
    )
    ends = database_end(len(source), times=source.times)
    return score_top1_by_distance(source, result, ends, right=lambda apart: apart <= POSITIVE_M, wrong=wrong, seed=seed)


def _metres() -> str:
    return f"{POSITIVE_M:g} m / {NEGATIVE_M:g} m"


def _excluded(source: Source) -> str:
    return f"last {EXCLUDED_FRAMES} frames excluded" if source.times is None else f"last {EXCLUDED_S:g} s excluded"
