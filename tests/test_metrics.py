"""Curves of precision and recall against scikit-learn."""

import warnings

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from sklearn.metrics import average_precision_score, precision_recall_curve

from sglpr_jax.metrics import decision_curve

TIED_SCORES = st.integers(-3, 3).map(float)
SCORES = st.floats(-1e3, 1e3)


def classification_curve(scores, positive, **options):
    """The curve of items that are positive or negative."""
    flags = {"true_if_accepted": positive, "false_if_accepted": ~positive, "missed_if_rejected": positive}
    return decision_curve(scores, **flags, **options)


def assert_is_sklearns(scores, positive):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "No positive class found", UserWarning)
        precision, recall, thresholds = precision_recall_curve(positive, scores)
        average_precision = average_precision_score(positive, scores)
    curve = classification_curve(scores, positive)
    np.testing.assert_array_equal(curve.thresholds, thresholds)
    # scikit-learn adds a last point, precision 1 and recall 0, at which nothing is accepted.
    np.testing.assert_allclose(curve.precision, precision[:-1], atol=1e-12)
    np.testing.assert_allclose(curve.recall, recall[:-1], atol=1e-12)
    with np.errstate(invalid="ignore"):
        f1 = np.nan_to_num(2 * precision * recall / (precision + recall))
    np.testing.assert_allclose(curve.f1_max, f1.max(), atol=1e-12)
    np.testing.assert_allclose(curve.average_precision, average_precision, atol=1e-12)
    assert_needs_no_other_thresholds(scores, positive, curve)


def assert_needs_no_other_thresholds(scores, positive, curve):
    """F1max, where it is, and average precision rest on the scores of the positive items alone."""
    if positive.any():
        short = classification_curve(scores, positive, thresholds=np.unique(scores[positive]))
        assert short.f1_max == curve.f1_max
        assert short.thresholds[short.best] == curve.thresholds[curve.best]
        np.testing.assert_allclose(short.average_precision, curve.average_precision, atol=1e-12)


@given(st.lists(st.tuples(TIED_SCORES | SCORES, st.booleans()), min_size=1, max_size=40))
@settings(deadline=None, max_examples=100)
@example([(0.5, True)])  # one query
@example([(0.5, False)])
@example([(0.5, True), (0.5, False), (0.5, False)])  # all ties
@example([(0.5, True), (0.5, True)])
@example([(0.0, False), (-0.0, True)])
@example([(1.0, False), (2.0, False)])  # no positives
@example([(1.0, True), (1.0, False), (1.0, True)])
def test_the_curve_is_scikit_learns(items):
    scores, positive = zip(*items, strict=True)
    assert_is_sklearns(np.array(scores), np.array(positive))


def count_decisions(scores, threshold, right, wrong, missed):
    accepted = scores >= threshold
    tp, fp, fn = np.sum(accepted & right), np.sum(accepted & wrong), np.sum(~accepted & missed)
    return tp / max(tp + fp, 1), tp / max(tp + fn, 1)


@given(st.lists(st.tuples(TIED_SCORES, st.integers(0, 2), st.booleans()), min_size=1, max_size=30))
@settings(deadline=None, max_examples=50)
def test_decisions_are_counted_at_every_distinct_score(items):
    scores, outcome, missed = map(np.array, zip(*[*items, (0.0, 2, True)], strict=True))
    right, wrong = outcome == 0, outcome == 1
    curve = decision_curve(scores, true_if_accepted=right, false_if_accepted=wrong, missed_if_rejected=missed)
    assert curve.thresholds.tolist() == sorted(set(scores))
    expected = [count_decisions(scores, threshold, right, wrong, missed) for threshold in curve.thresholds]
    np.testing.assert_allclose(np.stack([curve.precision, curve.recall], axis=1), expected, atol=1e-12)


def test_best_is_the_highest_of_equally_good_thresholds():
    curve = classification_curve(np.array([3.0, 2.0, 1.0, 0.0]), np.array([True, False, False, True]))
    # F1 is 2/3 when only the first is accepted, and again when all four are.
    assert curve.f1_max == pytest.approx(2 / 3)
    assert curve.thresholds[curve.best] == 3.0


def test_a_score_of_minus_infinity_is_never_accepted():
    scores, positive = np.array([2.0, -np.inf, 1.0, -np.inf]), np.array([True, True, False, False])
    curve = classification_curve(scores, positive)
    assert curve.thresholds.tolist() == [1.0, 2.0]
    assert curve.precision.tolist() == [0.5, 1.0]
    assert curve.recall.tolist() == [0.5, 0.5]
    for wrong in (scores[[1, 3]], np.array([np.nan, np.inf])):
        with pytest.raises(ValueError, match="expected finite scores, found 2 of 2"):
            classification_curve(wrong, positive[[1, 3]])


def test_a_threshold_for_a_precision_keeps_as_much_recall_as_it_allows():
    """By hand: right, right, wrong, right, wrong, from the highest score."""
    curve = classification_curve(np.array([5.0, 4, 3, 2, 1]), np.array([True, True, False, True, False]))
    assert curve.thresholds[curve.at_precision(1.0)] == 4
    assert curve.thresholds[curve.at_precision(0.7)] == 2
    assert curve.thresholds[curve.at_precision(0.6)] == 2  # 1 adds no recall
    wrong = classification_curve(np.array([2.0, 1]), np.array([False, True]))
    assert wrong.at_precision(0.99) is None
