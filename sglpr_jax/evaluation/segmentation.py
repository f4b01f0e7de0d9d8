"""Intersection over union (IoU) of semantic maps, and the IoU of predicting the most frequent class everywhere."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.evaluation.plain_table import PlainTable
from sglpr_jax.labels import UNLABELLED, taxonomy
from sglpr_jax.retrieval.image_maps import SemanticMap


@dataclass(frozen=True, eq=False)
class SegmentationResult:
    """Segmentation scores over all counted cells."""

    iou: Float[np.ndarray, " k"]
    """Intersection over union of each class, NaN for a class without cells."""
    shares: Float[np.ndarray, " k"]
    """Fraction of the cells that belong to each class."""
    cells: int

    @property
    def mean_iou(self) -> float:
        """Mean IoU over the classes that occur."""
        return float(np.nanmean(self.iou))

    @property
    def present(self) -> int:
        """Number of classes that occur."""
        return int((self.shares > 0).sum())

    @property
    def majority(self) -> int:
        """Id of the most frequent class."""
        return int(self.shares.argmax())

    @property
    def majority_mean_iou(self) -> float:
        """Mean IoU of predicting the most frequent class everywhere."""
        return float(self.shares.max() / self.present)


def confusion_matrix(
    truth: Int[np.ndarray, "*b h w"],
    prediction: Int[np.ndarray, "*b h w"],
    *,
    counted: Bool[np.ndarray, "*b h w"],
    classes: int,
) -> Int[np.ndarray, "k k"]:
    """Return the number of counted cells of true class i that are predicted as class j.

    As in SemanticKITTI, cells of class 0 (unlabelled) are ignored. Matrices of several scans may be added.
    """
    counted = counted & (truth != UNLABELLED)
    pairs = truth[counted].astype(np.int64) * classes + prediction[counted]
    return np.bincount(pairs, minlength=classes**2).reshape(classes, classes)


def score_confusion(confusion: Int[np.ndarray, "k k"]) -> SegmentationResult:
    """Return the scores of a confusion matrix. Raises ValueError if no cell was counted."""
    cells_of_class = confusion.sum(1)
    cells = int(cells_of_class.sum())
    if not cells:
        raise ValueError("expected cells with points and labels, found none")
    union = cells_of_class + confusion.sum(0) - np.diag(confusion)
    iou = np.where(cells_of_class > 0, np.diag(confusion) / np.maximum(union, 1), np.nan)
    return SegmentationResult(iou=iou, shares=cells_of_class / cells, cells=cells)


def map_confusion(found: SemanticMap, *, categories: int) -> Int[np.ndarray, "k k"]:
    """Return the confusion matrix of one semantic map, over the cells that have a prediction and a label.

    It is all zeros for a scan without labels.
    """
    classes = len(taxonomy(categories).names)
    return confusion_matrix(found.truth, found.predicted, counted=found.seen, classes=classes)


def segmentation_table(result: SegmentationResult, *, categories: int, title: str = "") -> PlainTable:
    """Return a table with a row for each class that occurs, and rows for the means."""
    names = taxonomy(categories).names
    table = PlainTable(title=title, caption=f"{result.cells} cells with points and a label")
    for column in ("class", "share of the cells", "IoU"):
        table.add_column(column, justify="left" if column == "class" else "right")
    for name, share, iou in zip(names, result.shares, result.iou, strict=True):
        if share:
            table.add_row(name, f"{share:.2%}", f"{iou:.3f}")
    table.add_section()
    table.add_row(f"mean of {result.present} classes", "", f"{result.mean_iou:.3f}")
    table.add_row(f"{names[result.majority]} everywhere", "", f"{result.majority_mean_iou:.3f}")
    return table


def segmentation_json(result: SegmentationResult, *, categories: int) -> dict[str, Any]:
    """Return values for `json.dump`. The score of a class that does not occur is null."""
    names = taxonomy(categories).names

    def by_name(values: np.ndarray) -> dict[str, float | None]:
        return {name: None if np.isnan(x) else float(x) for name, x in zip(names, values, strict=True)}

    return {
        "mean_iou": result.mean_iou,
        "majority": names[result.majority],
        "majority_mean_iou": result.majority_mean_iou,
        "cells": result.cells,
        "iou": by_name(result.iou),
        "shares": by_name(result.shares),
    }
