"""Result of a protocol, and F1max with its bootstrap interval."""

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
    """Score of one input by one protocol, with the rule and counts that define it."""

    name: str
    rule: str
    """Rule of the protocol in words, with its distances."""
    dimensions: int | None
    """Dimensions of distances between frames: 2 for x and y, 3 for x, y and z, None if labels were given instead."""
    pose_source: str | None
    """Source of the poses, in words."""
    published_on: str
    """Poses of the published numbers of the protocol. Scores on other poses differ."""
    counts: dict[str, int] = field(default_factory=dict)
    """Numbers of queries and revisits, or of pairs."""
    score: float = np.nan
    """Score, NaN for a sequence without a revisit."""
    interval: tuple[float, float] | None = None
    """95 % bootstrap interval of the score, or None without a score."""
    curve: PrecisionRecallCurve | None = None
    """Curve with negated descriptor distances as thresholds. None for a recall and without a revisit."""
    recalls: dict[int, float] = field(default_factory=dict)
    """Recall@N by N, if the protocol defines it."""
    decisions: Int8[np.ndarray, " n"] | None = None
    """`Decision` of each frame. None for pairs and across sessions."""
    answers: Int64[np.ndarray, " n"] | None = None
    """Answer to each frame, -1 for frames without an answer. None if the protocol applies no threshold."""
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
    """Add F1max, its curve and its interval. Scores, `flags` and `thresholds` are those of `metrics.decision_curve`."""
    curve = decision_curve(scores, thresholds=thresholds, **flags)
    interval = percentile_interval(resampled_f1_max(scores, query=query, seed=seed, **flags))
    return replace(result, score=curve.f1_max, curve=curve, interval=interval)


def percentile_interval(scores: Float[np.ndarray, " resamples"]) -> tuple[float, float]:
    """Return the interval of resampled scores.

    Neighbouring frames of a recording are correlated, so the true uncertainty is larger.
    """
    low, high = np.quantile(scores, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def resampled_means(hits: Bool[np.ndarray, " q"], rng: np.random.Generator) -> Float[np.ndarray, " resamples"]:
    """Return the fraction of correctly answered queries in each resample of q >= 1 queries."""
    # The number of hits among q draws with replacement is binomial, so single draws are not needed.
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
    """Return F1max of each resample. Scores and flags are those of `metrics.decision_curve`.

    The items of a query are drawn or omitted together. With the same seed, methods that answer the same queries get the
    same resamples. Each resample has its own best threshold. Candidates are at most 256 scores of items that are right
    or could be missed, because accepting other items cannot increase F1.
    """
    if not np.any(true_if_accepted & np.isfinite(scores)):
        return np.zeros(RESAMPLES)
    edges = np.unique(scores[(true_if_accepted | missed_if_rejected) & np.isfinite(scores)])
    edges = edges[np.unique(np.linspace(0, len(edges) - 1, THRESHOLDS).round().astype(np.int64))]
    bins = np.searchsorted(edges, scores, side="right")  # an item is accepted at the thresholds edges[:bins]
    queries, row = np.unique(query, return_inverse=True)
    n, shape = len(queries), (len(queries), len(edges) + 1)

    def accepted(flags: Bool[np.ndarray, " n"]) -> Float32[np.ndarray, "queries edges"]:
        cells = np.bincount(row[flags] * shape[1] + bins[flags], minlength=shape[0] * shape[1]).reshape(shape)
        return np.cumsum(cells[:, ::-1], axis=1)[:, ::-1].astype(np.float32)

    right, wrong, caught = accepted(true_if_accepted), accepted(false_if_accepted), accepted(missed_if_rejected)
    twice_right = 2 * right[:, 1:]
    # F1 = 2 TP / (2 TP + FP + FN). Each count is a sum over queries, weighted by the number of times a query is drawn.
    draws = np.random.default_rng(seed).integers(n, size=(RESAMPLES, n)) + n * np.arange(RESAMPLES)[:, None]
    weights = np.bincount(draws.ravel(), minlength=RESAMPLES * n).reshape(RESAMPLES, n).astype(np.float32)
    denominator = weights @ (twice_right + wrong[:, 1:] + caught[:, :1] - caught[:, 1:])
    f1 = np.divide(weights @ twice_right, denominator, out=np.zeros_like(denominator), where=denominator > 0)
    return f1.max(axis=1).astype(np.float64)
