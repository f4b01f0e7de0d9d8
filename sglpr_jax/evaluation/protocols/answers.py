"""Top-1 retrieval: the nearest frame answers each query, and a threshold accepts or rejects the answer."""

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
    """Answers to q queries and their labels according to a protocol."""

    queries: Int[np.ndarray, " q"]
    """Frames of the queries."""
    nearest: Int[np.ndarray, " q"]
    """Frame of each answer, -1 without an answer."""
    distance: Float[np.ndarray, " q"]
    """Descriptor distance of each answer, infinite without an answer."""
    right: Bool[np.ndarray, " q"]
    """Whether the answer is a true positive once accepted."""
    wrong: Bool[np.ndarray, " q"]
    """Whether the answer is a false positive once accepted. Accepted answers that are neither are not counted."""
    revisited: Bool[np.ndarray, " q"]
    """Whether the database has a right answer. If so, a rejected query is a false negative."""


def score_top1_by_distance(
    source: Source, result: Result, ends: Int[np.ndarray, " n"], *, right: Near, wrong: Near, seed: int
) -> Result:
    """Complete `result` with top-1 answers that are right or wrong according to their distance in metres.

    A query is a revisit if a frame of its database would be a right answer.

    Arguments:
      source: Descriptors or a top-k list with scores.
      result: Result to complete. Its `dimensions` are those of the distances.
      ends: For each frame, the number of first frames that are its database. A frame with 0 is not a query.
      right: Whether an answer at this distance is right.
      wrong: Whether an answer at this distance is wrong.
      seed: Seed of the bootstrap interval.
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
    """Complete `result` with counts and decisions and, if there is a revisit, with F1max, its curve and interval.

    Recall@1 is added: the share of revisits with a right answer, without a threshold. Raises ValueError for a top-k
    list without scores.
    """
    if isinstance(source, TopK) and source.scores is None:
        raise ValueError(f"{result.name}: expected a list with scores for the threshold, found no scores")
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
    """Return answers and distances for every frame, as fields of `Result`."""
    nearest, distance = np.full(n, -1, dtype=np.int64), np.full(n, np.inf)
    nearest[answers.queries], distance[answers.queries] = answers.nearest, answers.distance
    return {"answers": nearest, "answer_distances": distance}


def older_by(n: int, frames: int) -> Int[np.ndarray, " {n}"]:
    """Return, for each of n frames, the number of frames that are at least `frames` older. They are its database."""
    return np.maximum(np.arange(n) - frames + 1, 0)


def _decide(accepted: Bool[np.ndarray, " q"], answers: Answers) -> Int8[np.ndarray, " q"]:
    """Return the `Decision` for each query."""
    return np.select(
        [accepted & answers.right, accepted & answers.wrong, accepted, answers.revisited],
        [Decision.TRUE_POSITIVE, Decision.FALSE_POSITIVE, Decision.UNCOUNTED, Decision.FALSE_NEGATIVE],
        Decision.TRUE_NEGATIVE,
    ).astype(np.int8)
