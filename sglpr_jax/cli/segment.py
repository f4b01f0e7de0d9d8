"""bin/segment: write the semantic map of every scan or image of a sequence; score them where there are labels."""

import dataclasses
import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import UInt
from PIL import Image
from rich.table import Table

from sglpr_jax.bev import uncropped
from sglpr_jax.cli.runtime import console, progress_bar, run, write_json
from sglpr_jax.data import Drive, ImageSequence, open_sequence
from sglpr_jax.data.label_maps import label_map_pixels
from sglpr_jax.data.scan_files import ScanFormat
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.segmentation import SegmentationResult, confusion_matrix, score_confusion
from sglpr_jax.labels import label_map, to_raw
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.params import load
from sglpr_jax.models.sglpr import Params
from sglpr_jax.retrieval.semantic_maps import SemanticMap, read_semantic_map

RESULT_FILE = "segmentation.json"


@dataclasses.dataclass(frozen=True)
class SegmentCommand:
    """Write each scan's semantic map as seen from above, one PNG of class ids (docs/labels.md) per scan.

    Of a ready-made image it is a label map, pixel for pixel on the image, as bin/train --pseudo-labels reads it. With
    labels, also the intersection over union of every class and a picture of one scan (figure 7).

    Examples:
      bin/segment --weights runs/small-08 --data KITTI --seq 08 --out maps/
      bin/segment --weights runs/simulated --data IMAGES --seq 06 --min-confidence 0.8 --out pseudo/06
    """

    weights: str
    """The name of shipped weights, a training run's folder, or one with config.json and model.safetensors."""
    data: Path
    """A dataset (KITTI's or NCLT's layout, ready-made BEV images) or a folder of scans (.bin, .pcd)."""
    out: Path
    """The folder to write to; made if need be."""
    seq: str | None = None
    """Which sequence; may be left out where there is only one."""
    format: ScanFormat = "auto"
    """What the scans of a plain folder are, where their names do not tell."""
    min_confidence: float = 0.0
    """Leave cells unlabelled, and out of the score, whose likeliest class has a smaller probability."""


def segment_sequence(command: SegmentCommand) -> Path:
    """Do what the command says; returns the folder written."""
    sequence = open_sequence(command.data, command.seq, format=command.format)
    if not 0 <= command.min_confidence <= 1:
        raise ValueError(f"--min-confidence is a probability: expected 0 to 1, found {command.min_confidence}")
    params = load(command.weights)
    if not params.config.segments:
        raise ValueError(f"{command.weights}: expected weights with a segmentation head, found none in them")
    command.out.mkdir(parents=True, exist_ok=True)
    labelled = cells = 0
    for row, found in _maps(params, sequence, range(len(sequence)), command.min_confidence):
        _write_png(command.out / f"{sequence.ids[row]}.png", _pixels(found, sequence, row, params.config))
        labelled, cells = labelled + found.seen.sum(), cells + (found.counts > 0).sum()
    print(f"{command.out}: {len(sequence)} semantic maps of {labelled / max(cells, 1):.0%} of the cells with points")
    if sequence.has_labels:
        scores = score_semantics(params, sequence, command.out, min_confidence=command.min_confidence)
        write_json(command.out / RESULT_FILE, scores)
    return command.out


def score_semantics(params: Params, sequence: Drive, folder: Path, *, min_confidence: float = 0.0) -> dict[str, Any]:
    """Score the segmentation head on every labelled scan; print, and draw input, truth and prediction of one.

    Cells whose likeliest class is less probable than `min_confidence` are not counted.
    """
    rows = [row for row, path in enumerate(sequence.label_paths) if path is not None]
    classes, names = params.config.classes, label_map(params.config.categories).names
    confusion = np.zeros((classes, classes), np.int64)
    for row, found in _maps(params, sequence, rows, min_confidence):
        confusion += confusion_matrix(found.truth, found.predicted, counted=found.seen, classes=classes)
        if row == rows[len(rows) // 2]:
            _draw(found, params.config, folder)
    result = score_confusion(confusion)
    console().print(_table(result, names, f"segmentation of {len(rows)} scans of {sequence.name}"))
    return _as_json(result, names)


def _maps(
    params: Params, sequence: Drive, rows: range | list[int], min_confidence: float
) -> Iterator[tuple[int, SemanticMap]]:
    with progress_bar(f"segment {sequence.name}", len(rows)) as show:
        for done, row in enumerate(rows):
            yield row, read_semantic_map(params, sequence, row, min_confidence=min_confidence)
            show(done + 1)


def _draw(found: SemanticMap, config: ModelConfig, folder: Path) -> None:
    if importlib.util.find_spec("matplotlib"):
        about = {"resolution_m": config.grid.resolution_m, "categories": config.categories}
        panel = figures.segmentation_panel(found.counts, found.truth, found.predicted, **about)
        figures.save(panel, folder / "segmentation.png")


def _table(result: SegmentationResult, names: tuple[str, ...], title: str) -> Table:
    table = Table(title=title, caption=f"{result.cells} cells with points and a label")
    for column in ("class", "share of the cells", "IoU"):
        table.add_column(column, justify="left" if column == "class" else "right")
    for name, share, iou in zip(names, result.shares, result.iou, strict=True):
        if share:
            table.add_row(name, f"{share:.2%}", f"{iou:.3f}")
    table.add_section()
    table.add_row(f"mean of {result.present} classes", "", f"{result.mean_iou:.3f}")
    table.add_row(f"{names[result.majority]} everywhere", "", f"{result.majority_mean_iou:.3f}")
    return table


def _as_json(result: SegmentationResult, names: tuple[str, ...]) -> dict[str, Any]:
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


def _pixels(found: SemanticMap, sequence: Drive, row: int, config: ModelConfig) -> UInt[np.ndarray, "rows columns"]:
    """What is written of a map: class ids on the model's grid; of an image its label map, 0 beyond the grid."""
    if not isinstance(sequence, ImageSequence):
        return found.predicted.astype(np.uint8)
    raw = to_raw(found.predicted, categories=config.categories)
    return label_map_pixels(uncropped(raw, shape=sequence.image(row).shape))


def _write_png(path: Path, pixels: UInt[np.ndarray, "rows columns"]) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    Image.fromarray(pixels).save(temporary, format="PNG")
    os.replace(temporary, path)


def main() -> None:
    """The entry point."""
    run(lambda: segment_sequence(tyro.cli(SegmentCommand, prog="segment")))


if __name__ == "__main__":
    main()
