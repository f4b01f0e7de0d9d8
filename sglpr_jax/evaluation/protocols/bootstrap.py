"""Bootstrap confidence intervals: how far a score moves when the queries are drawn anew.

Queries are drawn with replacement, as many as there are. Neighbouring frames of a recording resemble each other, so
that they are worth less than as many independent queries: read an interval as the least uncertainty there is.
"""

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

RESAMPLES = 500
CONFIDENCE = 0.95
THRESHOLDS = 256
"""A resample looks for its F1max at so many thresholds at most."""


def interval(scores: Float[np.ndarray, " resamples"]) -> tuple[float, float]:
    """Return the percentile interval of a score's resamples."""
    low, high = np.quantile(scores, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def resampled_means(found: Bool[np.ndarray, " q"], rng: np.random.Generator) -> Float[np.ndarray, " resamples"]:
    """Return the share of queries found in every resample of q >= 1 queries."""
    # The number found among q draws with replacement is binomial, so nothing need be drawn one by one.
    return rng.binomial(len(found), np.mean(found), RESAMPLES) / len(found)


def f1_max_interval(
    scores: Float[np.ndarray, " n"], *, query: Int[np.ndarray, " n"], seed: int, **flags: Bool[np.ndarray, " n"]
) -> tuple[float, float]:
    """Return the interval of F1max over the decisions whose `flags` `resampled_f1_max` names."""
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
    """Return F1max, over the decisions of `metrics.decision_curve`, in every resample; item i is `query[i]`'s.

    With one seed, two methods that answer the same queries meet the same resamples. All items of a query are drawn or
    left out together. Every resample has its own best threshold, sought among at most 256 scores of items that are
    right or could be missed: accepting any other cannot raise F1.
    """
    if not np.any(true_if_accepted & np.isfinite(scores)):
        return np.zeros(RESAMPLES)
    edges = np.unique(scores[(true_if_accepted | missed_if_rejected) & np.isfinite(scores)])
    edges = edges[np.unique(np.linspace(0, len(edges) - 1, THRESHOLDS).round().astype(np.int64))]
    bins = np.searchsorted(edges, scores, side="right")  # accepted at the edges [:bins]
    queries, row = np.unique(query, return_inverse=True)
    shape = (len(queries), len(edges) + 1)

    def accepted(flags: Bool[np.ndarray, " n"]) -> Float32[np.ndarray, "queries edges"]:
        cells = np.bincount(row[flags] * shape[1] + bins[flags], minlength=shape[0] * shape[1]).reshape(shape)
        return np.cumsum(cells[:, ::-1], axis=1)[:, ::-1].astype(np.float32)

    right, wrong, caught = accepted(true_if_accepted), accepted(false_if_accepted), accepted(missed_if_rejected)
    twice_right = 2 * right[:, 1:]
    # F1 = 2 TP / (2 TP + FP + FN); each is a sum over queries, so a resample is a product with how often each is drawn.
    drawn = _times_drawn(shape[0], seed)
    whole = drawn @ (twice_right + wrong[:, 1:] + caught[:, :1] - caught[:, 1:])
    f1 = np.divide(drawn @ twice_right, whole, out=np.zeros_like(whole), where=whole > 0)
    return f1.max(axis=1).astype(np.float64)


def _times_drawn(n: int, seed: int) -> Float32[np.ndarray, "resamples {n}"]:
    """Return how often each of n items is in every resample."""
    drawn = np.random.default_rng(seed).integers(n, size=(RESAMPLES, n)) + n * np.arange(RESAMPLES)[:, None]
    return np.bincount(drawn.ravel(), minlength=RESAMPLES * n).reshape(RESAMPLES, n).astype(np.float32)
