"""Top-1 retrieval: every query is answered with its nearest frame, and a threshold accepts or rejects the answer."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from sglpr_jax import metrics
from sglpr_jax.evaluation.protocols.bootstrap import f1_max_interval
from sglpr_jax.evaluation.protocols.nearest import nearest_frames
from sglpr_jax.evaluation.protocols.result import Decision, Result
from sglpr_jax.evaluation.protocols.source import Source, TopK, positions_of
from sglpr_jax.revisits import Near, has_near


@dataclass(frozen=True, eq=False)
class Answers:
    """One answer to each of q queries, and what it is by the protocol's rule."""

    queries: Int[np.ndarray, " q"]
    nearest: Int[np.ndarray, " q"]
    """The frame answered with; -1 where there is none."""
    distance: Float[np.ndarray, " q"]
    """Of the descriptors; infinite where there is no answer."""
    right: Bool[np.ndarray, " q"]
    wrong: Bool[np.ndarray, " q"]
    """An answer may be neither: then it counts for nothing once accepted."""
    revisited: Bool[np.ndarray, " q"]
    """Whether there was a right answer to find: then to reject is to miss."""


def score_top1_by_distance(
    source: Source, result: Result, ends: Int[np.ndarray, " n"], *, right: Near, wrong: Near, seed: int
) -> Result:
    """Complete `result` with the top-1 answers among the first `ends` frames (0: no query), judged by their distance.

    A query is a revisit if a frame of its database would be a right answer.
    """
    positions = positions_of(source, result.dimensions or 3)
    queries = np.flatnonzero(ends)
    nearest, distance = nearest_frames(source, queries, ends[queries])
    apart = np.linalg.norm(positions[queries] - positions[nearest[:, 0]], axis=1)
    answered = nearest[:, 0] >= 0
    revisited = has_near(positions[queries], positions, ends[queries], right)
    answers = Answers(queries, nearest[:, 0], distance, right(apart) & answered, wrong(apart) & answered, revisited)
    return score_answers(source, result, answers, seed=seed)


def score_answers(source: Source, result: Result, answers: Answers, *, seed: int) -> Result:
    """Complete `result` with counts, and where there is a revisit with F1max, its curve, interval and decisions.

    Recall@1 stands beside it: the share of revisits whose answer is right, with no threshold to reject it.
    """
    if isinstance(source, TopK) and source.scores is None:
        raise ValueError(f"{result.name}: expected a list with scores to put a threshold on, found none")
    queries, revisited = answers.queries, answers.revisited
    decisions = np.full(len(source), Decision.NOT_A_QUERY, dtype=np.int8)
    decisions[queries] = Decision.TRUE_NEGATIVE
    counts = {"queries": len(queries), "revisits": int(revisited.sum())}
    result = replace(result, counts=counts, decisions=decisions, **_whole_sequence(len(source), answers))
    if not revisited.any():
        return result
    flags = {
        "true_if_accepted": answers.right,
        "false_if_accepted": answers.wrong,
        "missed_if_rejected": revisited,
    }
    result = replace(result, recalls={1: float(np.mean(answers.right[revisited]))} | result.recalls)
    decisions[queries] = _decide(np.zeros(len(queries), dtype=bool), answers)
    if not np.isfinite(answers.distance).any():
        return replace(result, score=0.0, interval=(0.0, 0.0))
    curve = metrics.decision_curve(-answers.distance, **flags)
    decisions[queries] = _decide(-answers.distance >= curve.thresholds[curve.best], answers)
    interval = f1_max_interval(-answers.distance, **flags, query=queries, seed=seed)
    return replace(result, score=curve.f1_max, curve=curve, interval=interval)


def _whole_sequence(n: int, answers: Answers) -> dict[str, np.ndarray]:
    """Return the answers and their distances for every frame, as `Result` has them."""
    nearest, distance = np.full(n, -1, dtype=np.int64), np.full(n, np.inf)
    nearest[answers.queries], distance[answers.queries] = answers.nearest, answers.distance
    return {"answers": nearest, "answer_distances": distance}


def older_by(n: int, frames: int) -> Int[np.ndarray, " {n}"]:
    """Return for each of n frames how many are at least so many frames older: these are its database."""
    return np.maximum(np.arange(n) - frames + 1, 0)


def _decide(accepted: Bool[np.ndarray, " q"], answers: Answers) -> Int8[np.ndarray, " q"]:
    """Return the `Decision` for each query."""
    return np.select(
        [accepted & answers.right, accepted & answers.wrong, accepted, answers.revisited],
        [Decision.TRUE_POSITIVE, Decision.FALSE_POSITIVE, Decision.UNCOUNTED, Decision.FALSE_NEGATIVE],
        Decision.TRUE_NEGATIVE,
    ).astype(np.int8)
