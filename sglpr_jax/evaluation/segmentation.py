"""Scores the segmentation head: intersection over union (IoU) of semantic maps, and of a constant prediction."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.report import PrintsItself, TextTable
from sglpr_jax.labels import UNLABELLED, taxonomy
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.weights import Params
from sglpr_jax.progress import Progress, no_progress
from sglpr_jax.retrieval.image_maps import SemanticMap, semantic_map

if TYPE_CHECKING:
    import matplotlib.figure

PICTURE = "segmentation.png"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class SegmentationScore(PrintsItself):
    """IoU of each class over all cells with a label and a predicted class. Prints itself as a table."""

    iou: Float[np.ndarray, " k"]
    """Intersection over union of each class, NaN for a class without cells."""
    shares: Float[np.ndarray, " k"]
    """Fraction of the cells that belong to each class."""
    cells: int
    """Number of cells with a label and a predicted class."""
    categories: int = 20
    """Number of categories in the taxonomy of the classes (`labels.taxonomy`)."""
    title: str = ""

    @property
    def mean_iou(self) -> float:
        """Mean IoU over the classes that occur."""
        return float(np.nanmean(self.iou))

    @property
    def n_present(self) -> int:
        """Number of classes that occur."""
        return int((self.shares > 0).sum())

    @property
    def majority(self) -> str:
        """Name of the most frequent class."""
        return taxonomy(self.categories).names[int(self.shares.argmax())]

    @property
    def majority_mean_iou(self) -> float:
        """Mean IoU of predicting the most frequent class everywhere."""
        return float(self.shares.max() / self.n_present)  # the IoU of this class is its share, of the others 0

    def to_json(self) -> dict[str, Any]:
        """Return values for `json.dump`. The score of a class that does not occur is null."""
        names = taxonomy(self.categories).names
        iou = [None if np.isnan(score) else score for score in self.iou.tolist()]
        return {
            "mean_iou": self.mean_iou,
            "majority": self.majority,
            "majority_mean_iou": self.majority_mean_iou,
            "cells": self.cells,
            "iou": dict(zip(names, iou, strict=True)),
            "shares": dict(zip(names, self.shares.tolist(), strict=True)),
        }

    def __rich__(self) -> TextTable:
        header = ("class", "share of the cells", "IoU")
        classes = zip(taxonomy(self.categories).names, self.shares, self.iou, strict=True)
        rows = [(name, f"{share:.2%}", f"{iou:.3f}") for name, share, iou in classes if share]
        rows.append((f"mean of {self.n_present} classes", "", f"{self.mean_iou:.3f}"))
        rows.append((f"{self.majority} everywhere", "", f"{self.majority_mean_iou:.3f}"))
        return TextTable(header, rows, header[1:], self.title, f"{self.cells} cells with a label and a predicted class")


def segment_recording(
    params: Params,
    recording: Recording,
    folder: Path,
    *,
    on_map: Callable[[int, Scan, SemanticMap], None] | None = None,
    min_confidence: float = 0.0,
    progress: Progress = no_progress,
) -> SegmentationScore | None:
    """Predict semantic maps of a recording, score them, and draw the middle labelled scan into `folder` (figure 7).

    `on_map` is called with row, scan and map of every scan. Without it, only labelled scans are predicted. Returns None
    without labels. Raises ValueError if there are labels, but no labelled cell has a predicted class.
    """
    config = params.config
    labelled_rows = np.flatnonzero(recording.labelled).tolist()
    rows = labelled_rows if on_map is None else range(len(recording))
    confusion = np.zeros((config.classes, config.classes), np.int64)
    middle_map = None
    with progress(f"segment {recording.name}", len(rows)) as show:
        for done, row in enumerate(rows, start=1):
            scan = recording.scan(row)
            semantic = semantic_map(params, scan, min_confidence=min_confidence)
            if on_map is not None:
                on_map(row, scan, semantic)
            if labelled_rows and row == labelled_rows[len(labelled_rows) // 2]:
                middle_map = semantic
            confusion += confusion_matrix(
                semantic.truth, semantic.predicted, counted=semantic.seen, classes=config.classes
            )
            show(done)
    if middle_map is None:
        return None
    title = f"segmentation of {len(labelled_rows)} scans of {recording.name}"
    score = score_confusion(confusion, categories=config.categories, title=title)
    figures.save(draw_map(middle_map, config), folder / PICTURE)
    return score


def draw_map(
    semantic: SemanticMap, config: ModelConfig, *, labelled: bool = True, title: str = ""
) -> "matplotlib.figure.Figure":
    """Draw point counts and predicted classes of a scan, and the true classes if the scan is labelled (figure 7)."""
    return figures.segmentation_panel(
        semantic.counts,
        semantic.truth if labelled else None,
        semantic.predicted,
        resolution_m=config.grid.resolution_m,
        categories=config.categories,
        title=title,
    )


def confusion_matrix(
    truth: Int[np.ndarray, "*b h w"],
    prediction: Int[np.ndarray, "*b h w"],
    *,
    counted: Bool[np.ndarray, "*b h w"],
    classes: int,
) -> Int[np.ndarray, "k k"]:
    """Return the number of cells of true class i (row) that are predicted as class j (column).

    Cells that are not `counted` or unlabelled (class 0) are ignored. Matrices of several scans may be added.
    """
    counted = counted & (truth != UNLABELLED)
    matrix_cells = truth[counted].astype(np.int64) * classes + prediction[counted]
    return np.bincount(matrix_cells, minlength=classes**2).reshape(classes, classes)


def score_confusion(confusion: Int[np.ndarray, "k k"], *, categories: int = 20, title: str = "") -> SegmentationScore:
    """Return the scores of a confusion matrix (rows: true class). Raises ValueError if the matrix is all zero."""
    cells_of_class = confusion.sum(1)
    cells = int(cells_of_class.sum())
    if not cells:
        raise ValueError("expected cells with labels and predicted classes, found none")
    union = cells_of_class + confusion.sum(0) - np.diag(confusion)
    iou = np.where(cells_of_class > 0, np.diag(confusion) / np.maximum(union, 1), np.nan)
    return SegmentationScore(iou, cells_of_class / cells, cells, categories, title)
