"""Bootstrap confidence intervals of scores, from queries drawn with replacement.

Neighbouring frames of a recording are correlated, so the true uncertainty is larger than the interval.
"""

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

RESAMPLES = 500
"""Number of bootstrap resamples."""
CONFIDENCE = 0.95
"""Confidence level of the intervals."""
THRESHOLDS = 256
"""Maximum number of thresholds tried in each resample."""


def interval(scores: Float[np.ndarray, " resamples"]) -> tuple[float, float]:
    """Return the percentile interval of resampled scores."""
    low, high = np.quantile(scores, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def resampled_means(found: Bool[np.ndarray, " q"], rng: np.random.Generator) -> Float[np.ndarray, " resamples"]:
    """Return the share of found queries in each resample of q >= 1 queries."""
    # The number of found queries among q draws with replacement is binomial, so single draws are not needed.
    return rng.binomial(len(found), np.mean(found), RESAMPLES) / len(found)


def f1_max_interval(
    scores: Float[np.ndarray, " n"], *, query: Int[np.ndarray, " n"], seed: int, **flags: Bool[np.ndarray, " n"]
) -> tuple[float, float]:
    """Return the interval of F1max. `flags` are the flags of `resampled_f1_max`."""
    return interval(resampled_f1_max(scores, query=query, seed=seed, **flags))


def resampled_f1_max(
    scores: Float[np.ndarray, " n"],
    *,
    true_if_accepted: Bool[np.ndarray, " n"],
    false_if_accepted: Bool[np.ndarray, " n"],
    missed_if_rejected: Bool[np.ndarray, " n"],
    query: Int[np.ndarray, " n"],
    seed: int,
) -> Float[np.ndarray, " resamples"]:
    """Return F1max of each resample.

    The items of a query are drawn or omitted together. With the same seed, methods that answer the same queries get the
    same resamples. Each resample has its own best threshold. Candidates are at most 256 scores of items that are right
    or could be missed, because accepting other items cannot increase F1.

    Arguments:
      scores: Score of each item.
      true_if_accepted: As in `metrics.decision_curve`.
      false_if_accepted: As in `metrics.decision_curve`.
      missed_if_rejected: As in `metrics.decision_curve`.
      query: Query of each item.
      seed: Seed of the resamples.
    """
    if not np.any(true_if_accepted & np.isfinite(scores)):
        return np.zeros(RESAMPLES)
    edges = np.unique(scores[(true_if_accepted | missed_if_rejected) & np.isfinite(scores)])
    edges = edges[np.unique(np.linspace(0, len(edges) - 1, THRESHOLDS).round().astype(np.int64))]
    bins = np.searchsorted(edges, scores, side="right")  # an item is accepted at the thresholds edges[:bins]
    queries, row = np.unique(query, return_inverse=True)
    shape = (len(queries), len(edges) + 1)

    def accepted(flags: Bool[np.ndarray, " n"]) -> Float32[np.ndarray, "queries edges"]:
        cells = np.bincount(row[flags] * shape[1] + bins[flags], minlength=shape[0] * shape[1]).reshape(shape)
        return np.cumsum(cells[:, ::-1], axis=1)[:, ::-1].astype(np.float32)

    right, wrong, caught = accepted(true_if_accepted), accepted(false_if_accepted), accepted(missed_if_rejected)
    twice_right = 2 * right[:, 1:]
    # F1 = 2 TP / (2 TP + FP + FN). Each count is a sum over queries, weighted by the number of times a query is drawn.
    drawn = _times_drawn(shape[0], seed)
    whole = drawn @ (twice_right + wrong[:, 1:] + caught[:, :1] - caught[:, 1:])
    f1 = np.divide(drawn @ twice_right, whole, out=np.zeros_like(whole), where=whole > 0)
    return f1.max(axis=1).astype(np.float64)


def _times_drawn(n: int, seed: int) -> Float32[np.ndarray, "resamples {n}"]:
    """Return how often each of n items occurs in each resample."""
    drawn = np.random.default_rng(seed).integers(n, size=(RESAMPLES, n)) + n * np.arange(RESAMPLES)[:, None]
    return np.bincount(drawn.ravel(), minlength=RESAMPLES * n).reshape(RESAMPLES, n).astype(np.float32)
