"""Recall@N: the share of queries with a right answer among their first N answers."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from sglpr_jax.evaluation.protocols.bootstrap import interval, resampled_means
from sglpr_jax.evaluation.protocols.result import Decision, Result


def recall_at(ranks: Int[np.ndarray, " q"], numbers: Sequence[int]) -> dict[int, float]:
    """Return Recall@N for each N, given the rank (from 0) of the first right answer of each query."""
    return {n: float(np.mean(ranks < n)) for n in numbers}


def score_recall(
    result: Result,
    ranks: Int[np.ndarray, " q"],
    revisited: Bool[np.ndarray, " q"],
    *,
    numbers: Sequence[int] = (1,),
    seed: int,
) -> Result:
    """Complete `result` with counts and, if there is a revisit, with recalls. The score is the first recall.

    Only queries that are `revisited` count.
    """
    result = replace(result, counts={"queries": len(ranks), "revisits": int(revisited.sum())})
    if not revisited.any():
        return result
    found = ranks[revisited] < numbers[0]
    recalls = recall_at(ranks[revisited], numbers)
    bounds = interval(resampled_means(found, np.random.default_rng(seed)))
    return replace(result, score=recalls[numbers[0]], recalls=recalls, interval=bounds)


def recall_decisions(
    n: int, queries: Int[np.ndarray, " q"], ranks: Int[np.ndarray, " q"], revisited: Bool[np.ndarray, " q"]
) -> np.ndarray:
    """Return the `Decision` of each frame by its first answer, (n,) int8. Queries without a revisit are not counted."""
    decisions = np.full(n, Decision.NOT_A_QUERY, dtype=np.int8)
    found = np.where(ranks == 0, Decision.TRUE_POSITIVE, Decision.FALSE_NEGATIVE)
    decisions[queries] = np.where(revisited, found, Decision.UNCOUNTED)
    return decisions
