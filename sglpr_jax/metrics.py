"""Precision, recall and F1max from scores and decisions (eq. 9)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float


@dataclass(frozen=True, eq=False)
class PrecisionRecallCurve:
    """Precision and recall at every distinct score, taken as threshold: accepted is what scores no less than it."""

    thresholds: np.ndarray
    """(k,) float64, rising."""
    precision: np.ndarray
    """(k,) float64."""
    recall: np.ndarray
    """(k,) float64."""

    @property
    def f1(self) -> Float[np.ndarray, " k"]:
        """The harmonic mean of precision and recall; 0 where both are 0."""
        return _ratio(2 * self.precision * self.recall, self.precision + self.recall)

    @property
    def average_precision(self) -> float:
        """The area under the curve as steps: each precision times how much recall it adds."""
        return float(np.sum(self.precision * -np.diff(self.recall, append=0.0)))

    @property
    def best(self) -> int:
        """Where F1 is highest; of equal ones the highest threshold."""
        return len(self.thresholds) - 1 - int(np.argmax(self.f1[::-1]))

    @property
    def f1_max(self) -> float:
        """The highest F1 over all thresholds."""
        return float(self.f1[self.best])


def decision_curve(
    scores: Float[np.ndarray, " n"],
    *,
    true_if_accepted: Bool[np.ndarray, " n"],
    false_if_accepted: Bool[np.ndarray, " n"],
    missed_if_rejected: Bool[np.ndarray, " n"],
    thresholds: Float[np.ndarray, " k"] | None = None,
) -> PrecisionRecallCurve:
    """Return the curve of n >= 1 decisions to accept or reject; equal scores are accepted together.

    An accepted item is a true positive, a false positive or, flagged as neither, counts for nothing; a rejected one is
    a false negative or a true negative. A score of -inf is rejected at every threshold. Where no item could be missed,
    recall is 1, as scikit-learn has it; elsewhere 0 / 0 is 0. `thresholds`, rising and distinct, replace the distinct
    scores. Raises ValueError where another score is not finite, or none is.
    """
    finite = np.isfinite(scores)
    if not finite.any() or not np.all(finite | np.isneginf(scores)):
        raise ValueError(f"expected finite scores, found {np.sum(~finite)} of {len(scores)} that are not")
    thresholds = np.unique(scores[finite]) if thresholds is None else thresholds
    accepted_up_to = np.searchsorted(thresholds, scores, side="right")

    def accepted(flags):
        counts = np.bincount(accepted_up_to[flags], minlength=len(thresholds) + 1)[1:]
        return np.cumsum(counts[::-1], dtype=np.float64)[::-1]

    true_positives = accepted(true_if_accepted)
    false_negatives = np.sum(missed_if_rejected) - accepted(missed_if_rejected)
    precision = _ratio(true_positives, true_positives + accepted(false_if_accepted))
    recall = _ratio(true_positives, true_positives + false_negatives)
    return PrecisionRecallCurve(thresholds, precision, recall if np.any(missed_if_rejected) else np.ones_like(recall))


def classification_curve(
    scores: Float[np.ndarray, " n"],
    positive: Bool[np.ndarray, " n"],
    *,
    thresholds: Float[np.ndarray, " k"] | None = None,
) -> PrecisionRecallCurve:
    """Return the curve of n >= 1 items that are positive or negative: accepting one is right just if it is positive."""
    return decision_curve(
        scores,
        true_if_accepted=positive,
        false_if_accepted=~positive,
        missed_if_rejected=positive,
        thresholds=thresholds,
    )


def _ratio(part: Float[np.ndarray, " k"], whole: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """Return part / whole, 0 where whole is 0."""
    return np.divide(part, whole, out=np.zeros_like(part), where=whole > 0)
