"""Precision, recall and F1max from scores and decisions (equation 9)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float


@dataclass(frozen=True, eq=False)
class PrecisionRecallCurve:
    """Precision and recall at every threshold. A threshold accepts the scores at or above it."""

    thresholds: Float[np.ndarray, " k"]
    """Increasing thresholds, by default the distinct scores."""
    precision: Float[np.ndarray, " k"]
    recall: Float[np.ndarray, " k"]

    @property
    def f1(self) -> Float[np.ndarray, " k"]:
        """Harmonic mean of precision and recall, or 0 where both are 0."""
        return _ratio(2 * self.precision * self.recall, self.precision + self.recall)

    @property
    def average_precision(self) -> float:
        """Area under the curve as steps: the sum of each precision times the recall that it adds."""
        return float(np.sum(self.precision * -np.diff(self.recall, append=0.0)))

    @property
    def best(self) -> int:
        """Index of the threshold with the highest F1. Of equal ones, the last."""
        return len(self.thresholds) - 1 - int(np.argmax(self.f1[::-1]))

    def at_precision(self, precision: float) -> int | None:
        """Index of the threshold with the highest recall at this precision or more. Of equal ones, the last.

        None if no threshold has this precision and a recall above 0.
        """
        recall = np.where(self.precision >= precision, self.recall, 0.0)
        return len(recall) - 1 - int(np.argmax(recall[::-1])) if recall.any() else None

    @property
    def f1_max(self) -> float:
        """Highest F1 over all thresholds."""
        return float(self.f1[self.best])


def decision_curve(
    scores: Float[np.ndarray, " n"],
    *,
    true_if_accepted: Bool[np.ndarray, " n"],
    false_if_accepted: Bool[np.ndarray, " n"],
    missed_if_rejected: Bool[np.ndarray, " n"],
    thresholds: Float[np.ndarray, " k"] | None = None,
) -> PrecisionRecallCurve:
    """Return precision and recall of n >= 1 decisions to accept or reject an item, at every threshold of the score.

    An item with a score of -inf is rejected at every threshold. If no item is a false negative when rejected, recall is
    1, as in scikit-learn. Otherwise 0 / 0 is 0.

    Arguments:
      scores: Score of each item.
      true_if_accepted: Whether accepting the item is a true positive.
      false_if_accepted: Whether accepting the item is a false positive. An item may be neither.
      missed_if_rejected: Whether rejecting the item is a false negative.
      thresholds: Increasing thresholds that replace the distinct scores.

    Raises ValueError if a score is NaN or +inf, or if no score is finite.
    """
    finite = np.isfinite(scores)
    if not finite.any() or not np.all(finite | np.isneginf(scores)):
        raise ValueError(f"expected finite scores, found {np.sum(~finite)} of {len(scores)} that are not finite")
    thresholds = np.unique(scores[finite]) if thresholds is None else thresholds
    accepting_thresholds = np.searchsorted(thresholds, scores, side="right")  # number of thresholds, for each item

    def count_accepted(flags):
        """Number of accepted items with a flag at each threshold."""
        counts = np.bincount(accepting_thresholds[flags], minlength=len(thresholds) + 1)[1:]
        return np.cumsum(counts[::-1], dtype=np.float64)[::-1]

    true_positives = count_accepted(true_if_accepted)
    false_negatives = np.sum(missed_if_rejected) - count_accepted(missed_if_rejected)
    precision = _ratio(true_positives, true_positives + count_accepted(false_if_accepted))
    recall = _ratio(true_positives, true_positives + false_negatives)
    return PrecisionRecallCurve(thresholds, precision, recall if np.any(missed_if_rejected) else np.ones_like(recall))


def _ratio(part: Float[np.ndarray, " k"], whole: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """part / whole, or 0 where whole is 0."""
    return np.divide(part, whole, out=np.zeros_like(part), where=whole > 0)
