"""How well semantic maps are predicted: intersection over union, beside what the commonest class alone would score."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

UNLABELLED = 0


@dataclass(frozen=True, eq=False)
class SegmentationResult:
    """Scores over all cells that were counted."""

    iou: Float[np.ndarray, " k"]
    """Intersection over union of each class, NaN where no cell has it."""
    cells: int
    majority: int
    """The commonest class."""

    majority_mean_iou: float
    """The mean IoU of predicting `majority` everywhere."""

    @property
    def mean_iou(self) -> float:
        """The mean over the classes that occur."""
        return float(np.nanmean(self.iou))


def score_segmentation(
    truth: Int[np.ndarray, "*b h w"],
    prediction: Int[np.ndarray, "*b h w"],
    *,
    counted: Bool[np.ndarray, "*b h w"],
    classes: int,
) -> SegmentationResult:
    """Score class maps over the `counted` cells (those with points) whose true class is known.

    As in SemanticKITTI, class 0 (unlabelled) is no class to be found. Raises ValueError where no cell is left.
    """
    counted = counted & (truth != UNLABELLED)
    if not counted.any():
        raise ValueError("expected cells with points and labels, found none")
    pairs = np.bincount(truth[counted] * classes + prediction[counted], minlength=classes**2)
    confusion = pairs.reshape(classes, classes)
    cells_of_class = confusion.sum(1)
    union = cells_of_class + confusion.sum(0) - np.diag(confusion)
    present = cells_of_class > 0
    iou = np.where(present, np.diag(confusion) / np.maximum(union, 1), np.nan)
    return SegmentationResult(
        iou=iou,
        cells=int(counted.sum()),
        majority=int(cells_of_class.argmax()),
        majority_mean_iou=float(cells_of_class.max() / counted.sum() / present.sum()),
    )
