"""Result of a protocol, and F1max with its bootstrap interval. Used by all protocols."""

from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int8, Int64

from sglpr_jax.metrics import PrecisionRecallCurve, decision_curve

RESAMPLES = 500
"""Number of bootstrap resamples."""
CONFIDENCE = 0.95
"""Confidence level of the intervals."""
THRESHOLDS = 256
"""Maximum number of thresholds tried in each resample."""


class Decision(IntEnum):
    """Decision for one frame as a query, at the threshold of F1max."""

    NOT_A_QUERY = 0
    TRUE_POSITIVE = 1
    FALSE_POSITIVE = 2
    FALSE_NEGATIVE = 3
    TRUE_NEGATIVE = 4
    UNCOUNTED = 5
    """Query that the protocol does not count, for example a query answered with a frame 3 to 20 m away."""


@dataclass(frozen=True, eq=False)
class Result:
    """Score of one input by one protocol, with the distances and counts that it depends on."""

    name: str
    """Title of the protocol."""
    rule: str
    """Distances and gap of the protocol in words."""
    dimensions: int | None
    """Dimensions of distances between frames: 2 for x and y, 3 for x, y and z, None if labels were given instead."""
    pose_source: str | None
    """Source of the poses, in words."""
    published_on: str
    """Poses of the published numbers of the protocol. Scores on other poses differ."""
    counts: dict[str, int] = field(default_factory=dict)
    """Numbers of queries and revisits, or of pairs."""
    score: float = np.nan
    """F1max or Recall@N. NaN for a sequence without a revisit."""
    interval: tuple[float, float] | None = None
    """95 % bootstrap interval of the score, or None without a score."""
    curve: PrecisionRecallCurve | None = None
    """Curve with negated descriptor distances as thresholds. None if the score is a recall or NaN."""
    recalls: dict[int, float] = field(default_factory=dict)
    """Recall@N by N, if the protocol defines it."""
    decisions: Int8[np.ndarray, " n"] | None = None
    """`Decision` of each frame. None for pairs and across sessions."""
    answers: Int64[np.ndarray, " n"] | None = None
    """Retrieved frame of each frame as a query, -1 without one. None if the protocol applies no threshold."""
    answer_distances: Float64[np.ndarray, " n"] | None = None
    """Descriptor distance of each answer, infinite for frames without an answer."""


def with_f1_max(
    result: Result,
    scores: Float[np.ndarray, " n"],
    *,
    query: Int[np.ndarray, " n"],
    seed: int,
    thresholds: Float[np.ndarray, " k"] | None = None,
    **flags: Bool[np.ndarray, " n"],
) -> Result:
    """Return `result` with F1max, its curve and its bootstrap interval, which resamples the queries of the n items.

    Scores, `flags` (such as `true_if_accepted`) and `thresholds` are those of `metrics.decision_curve`.
    """
    curve = decision_curve(scores, thresholds=thresholds, **flags)
    interval = percentile_interval(resampled_f1_max(scores, query=query, seed=seed, **flags))
    return replace(result, score=curve.f1_max, curve=curve, interval=interval)


def percentile_interval(scores: Float[np.ndarray, " resamples"]) -> tuple[float, float]:
    """Return the 95 % interval of resampled scores. Frames are correlated, so the true interval is wider."""
    low, high = np.quantile(scores, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def resampled_means(hits: Bool[np.ndarray, " q"], rng: np.random.Generator) -> Float[np.ndarray, " resamples"]:
    """Return the fraction of correctly answered queries in each resample of q >= 1 queries."""
    # The number of hits among q draws with replacement is binomial, so single queries are not drawn.
    return rng.binomial(len(hits), np.mean(hits), RESAMPLES) / len(hits)


def resampled_f1_max(
    scores: Float[np.ndarray, " n"],
    *,
    true_if_accepted: Bool[np.ndarray, " n"],
    false_if_accepted: Bool[np.ndarray, " n"],
    missed_if_rejected: Bool[np.ndarray, " n"],
    query: Int[np.ndarray, " n"],
    seed: int,
) -> Float[np.ndarray, " resamples"]:
    """Return F1max of each bootstrap resample of the queries. Scores and flags are those of `metrics.decision_curve`.

    Items with the same `query` are drawn or omitted together. Methods that answer the same queries get the same
    resamples from the same seed. Each resample has its own best threshold, among at most 256 scores of items that are
    right or could be missed: accepting other items cannot increase F1.
    """
    if not np.any(true_if_accepted & np.isfinite(scores)):
        return np.zeros(RESAMPLES)
    thresholds = np.unique(scores[(true_if_accepted | missed_if_rejected) & np.isfinite(scores)])
    thresholds = thresholds[np.unique(np.linspace(0, len(thresholds) - 1, THRESHOLDS).round().astype(np.int64))]
    accepting = np.searchsorted(thresholds, scores, side="right")  # thresholds[:accepting] accept an item
    queries, query_row = np.unique(query, return_inverse=True)
    n, columns = len(queries), len(thresholds) + 1

    def count(flags: Bool[np.ndarray, " n"]) -> Float32[np.ndarray, "queries columns"]:
        """Count the flagged items of each query: in column 0 all, in column j + 1 those that thresholds[j] accepts."""
        cells = np.bincount(query_row[flags] * columns + accepting[flags], minlength=n * columns).reshape(n, columns)
        return np.cumsum(cells[:, ::-1], axis=1)[:, ::-1].astype(np.float32)

    tp, fp, not_missed = count(true_if_accepted)[:, 1:], count(false_if_accepted)[:, 1:], count(missed_if_rejected)
    fn = not_missed[:, :1] - not_missed[:, 1:]
    # F1 = 2 TP / (2 TP + FP + FN), where each count is a sum over queries, weighted by how often a query is drawn.
    draws = np.random.default_rng(seed).integers(n, size=(RESAMPLES, n)) + n * np.arange(RESAMPLES)[:, None]
    weights = np.bincount(draws.ravel(), minlength=RESAMPLES * n).reshape(RESAMPLES, n).astype(np.float32)
    denominator = weights @ (2 * tp + fp + fn)
    f1 = np.divide(weights @ (2 * tp), denominator, out=np.zeros_like(denominator), where=denominator > 0)
    return f1.max(axis=1).astype(np.float64)
