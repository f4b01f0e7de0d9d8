"""Score of the segmentation head on a labelled recording, with a result that prints itself and a figure."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from rich.console import Console, ConsoleOptions
from rich.table import Table

from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation import figures, report
from sglpr_jax.evaluation.segmentation import (
    SegmentationResult,
    map_confusion,
    score_confusion,
    segmentation_json,
    segmentation_table,
)
from sglpr_jax.models.params import Params
from sglpr_jax.progress import Progress, no_progress
from sglpr_jax.retrieval.image_maps import semantic_map, semantic_maps

PICTURE = "segmentation.png"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class SemanticScore(report.PrintsItself):
    """Intersection over union of each class over the semantic maps of a recording. Prints itself as a table."""

    title: str
    categories: int
    result: SegmentationResult

    def to_json(self) -> dict[str, Any]:
        """Return values for `json.dump`."""
        return segmentation_json(self.result, categories=self.categories)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table]:
        yield segmentation_table(self.result, categories=self.categories, title=self.title)


def score_semantics(
    params: Params,
    recording: Recording,
    *,
    folder: Path | None = None,
    min_confidence: float = 0.0,
    progress: Progress = no_progress,
) -> SemanticScore:
    """Score the segmentation head on every labelled scan of a recording.

    Arguments:
      params: Parameters of a network with a segmentation head.
      recording: Recording with labels.
      folder: Folder for a figure of one scan. The figure needs matplotlib.
      min_confidence: Minimum probability of the predicted class. Cells with a lower probability are not counted.
      progress: Reports the progress.

    Raises:
      ValueError: If no cell is counted.
    """
    rows, config = _labelled_rows(recording), params.config
    confusion = np.zeros((config.classes, config.classes), np.int64)
    with progress(f"segment {recording.name}", len(rows)) as show:
        for _, _, found in semantic_maps(params, recording, rows, min_confidence=min_confidence, on_progress=show):
            confusion += map_confusion(found, categories=config.categories)
    score = semantic_score(confusion, recording, categories=config.categories)
    if folder is not None:
        draw_semantics(params, recording, folder, min_confidence=min_confidence)
    return score


def semantic_score(confusion: Int[np.ndarray, "k k"], recording: Recording, *, categories: int) -> SemanticScore:
    """Return the score of a recording from the sum of the confusion matrices of its semantic maps (`map_confusion`).

    Raises ValueError if no cell was counted.
    """
    title = f"segmentation of {len(_labelled_rows(recording))} scans of {recording.name}"
    return SemanticScore(title, categories, score_confusion(confusion))


def draw_semantics(params: Params, recording: Recording, folder: Path, *, min_confidence: float = 0.0) -> None:
    """Draw input, truth and prediction of the middle labelled scan into `folder`. Does nothing without matplotlib."""
    if not figures.can_draw():
        return
    rows = _labelled_rows(recording)
    found = semantic_map(params, recording.record(rows[len(rows) // 2]), min_confidence=min_confidence)
    about = {"resolution_m": params.config.grid.resolution_m, "categories": params.config.categories}
    panel = figures.segmentation_panel(found.counts, found.truth, found.predicted, **about)
    figures.save(panel, folder / PICTURE)


def _labelled_rows(recording: Recording) -> list[int]:
    return [row for row, labelled in enumerate(recording.labelled) if labelled]
