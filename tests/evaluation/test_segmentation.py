import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sglpr_jax.evaluation.segmentation import SegmentationScore, confusion_matrix, score_confusion
from sglpr_jax.labels import taxonomy

CLASSES = 5
SHAPE = (2, 4, 4)
maps = arrays(np.int32, SHAPE, elements=st.integers(0, CLASSES - 1))


def score(truth, prediction, counted) -> SegmentationScore:
    return score_confusion(confusion_matrix(truth, prediction, counted=counted, classes=CLASSES))


def reference(truth, prediction, counted):
    """Return the intersection over union of each class, computed class by class."""
    counted = counted & (truth != 0)
    iou = np.full(CLASSES, np.nan)
    for c in np.unique(truth[counted]):
        a, b = truth[counted] == c, prediction[counted] == c
        iou[c] = (a & b).sum() / (a | b).sum()
    return iou


@settings(deadline=None, max_examples=25)
@given(truth=maps, prediction=maps, counted=arrays(bool, SHAPE))
def test_scores_equal_those_computed_class_by_class(truth, prediction, counted):
    counted[0, 0, 0], truth[0, 0, 0] = True, 3
    result = score(truth, prediction, counted)
    expected = reference(truth, prediction, counted)
    np.testing.assert_allclose(result.iou, expected)
    np.testing.assert_allclose(result.mean_iou, np.nanmean(expected))
    assert result.cells == (counted & (truth != 0)).sum()
    majority = taxonomy().names.index(result.majority)
    everywhere = np.full_like(truth, majority)
    np.testing.assert_allclose(result.majority_mean_iou, np.nanmean(reference(truth, everywhere, counted)))
    others = [(truth[counted] == c).sum() for c in range(1, CLASSES)]
    assert others[majority - 1] == max(others)


@pytest.mark.parametrize("label", [0, 1])
def test_no_counted_cell_is_an_error(label):
    truth = np.full((1, 2, 2), label, np.int32)
    with pytest.raises(ValueError, match="cells with labels and predicted classes, found none"):
        score(truth, truth, np.full(truth.shape, label == 0))
