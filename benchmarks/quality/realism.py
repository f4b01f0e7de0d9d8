"""Semantics of real scans by weights that were trained in the simulator."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import sglpr_jax
from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.recording import Record
from sglpr_jax.evaluation.figures import save, segmentation_panel
from sglpr_jax.evaluation.segmentation import confusion_matrix, score_confusion
from sglpr_jax.labels import CATEGORIES, UNLABELLED, to_raw
from sglpr_jax.models.params import Params
from sglpr_jax.retrieval.image_maps import semantic_map


def semantics(
    *,
    weights: str,
    out: Path,
    prior: Path,
    scans: tuple[Path, ...] = (),
    range_images: Path | None = None,
    prior_scans: int = 30,
) -> None:
    """Score semantics of real labelled scans: mean IoU beside that of the commonest class of each simulated cell.

    Args:
        weights: weights that were trained in the simulator.
        out: folder of pictures of real scans, which KITTI's licence keeps private.
        prior: simulated dataset from which each cell's commonest class is taken.
        scans: datasets in KITTI's layout; their labelled scans are scored.
        range_images: folder of labelled range images, NN_FFFFFF.npz with `points` and `label` (learning classes).
        prior_scans: scans of each simulated recording that make the prior.
    """
    params = sglpr_jax.load(weights)
    by_cell, classes = _commonest_by_cell(params, prior, prior_scans), params.config.classes
    totals: dict[str, np.ndarray] = {}
    for source, scan in _labelled_scans(scans, range_images):
        found = semantic_map(params, scan)
        if source not in totals:
            resolution_m = params.config.grid.resolution_m
            panel = segmentation_panel(found.counts, found.truth, found.predicted, resolution_m=resolution_m)
            save(panel, out / f"{source.replace(' ', '-')}.png")
        each = [
            confusion_matrix(found.truth, one, counted=found.seen, classes=classes)
            for one in (found.predicted, by_cell)
        ]
        totals[source] = totals.get(source, 0) + np.stack(each)
    totals["all"] = np.sum(list(totals.values()), axis=0)
    for source, matrices in totals.items():
        ours, guess = map(score_confusion, matrices)
        table = Table("class", "share of the cells", "IoU", "IoU of each cell's commonest class", title=source)
        for i in np.flatnonzero(ours.shares).tolist():
            table.add_row(CATEGORIES[i], f"{ours.shares[i]:.2%}", f"{ours.iou[i]:.3f}", f"{guess.iou[i]:.3f}")
        table.add_row(f"mean of {ours.present} classes", "", f"{ours.mean_iou:.3f}", f"{guess.mean_iou:.3f}")
        table.add_row(f"{CATEGORIES[ours.majority]} everywhere", "", f"{ours.majority_mean_iou:.3f}", "")
        Console(width=120).print(table)


def _labelled_scans(roots: tuple[Path, ...], range_images: Path | None) -> Iterator[tuple[str, Record]]:
    """Source and record of every scan that has labels."""
    for root in roots:
        for name in recording_names(root):
            recording = open_recording(root, name)
            for row, labelled in enumerate(recording.labelled):
                if labelled and not recording.has_images:
                    yield f"scans of {name}", recording.record(row)
    paths = sorted(range_images.glob("*.npz")) if range_images else []
    if range_images and not paths:
        raise SystemExit(f"{range_images}: expected range images (*.npz), found none")
    for path in paths:
        with np.load(path, allow_pickle=False) as file:
            points, classes = np.ascontiguousarray(file["points"][:, :3]), file["label"].astype(np.int32)
        yield f"range images of {path.stem[:2]}", Record(points=points, labels=to_raw(classes))


def _commonest_by_cell(params: Params, root: Path, scans: int) -> np.ndarray:
    """The commonest class of each cell (h, w) over simulated scans; road where none ever saw a point."""
    grid = params.config.grid
    votes = np.zeros((grid.height, grid.width, params.config.classes), np.int64)
    rows, columns = np.indices(votes.shape[:2])
    for name in recording_names(root):
        recording = open_recording(root, name)
        for row in np.linspace(0, len(recording) - 1, scans).astype(int):
            found = semantic_map(params, recording.record(row))
            votes[rows, columns, found.truth] += 1
    votes[..., UNLABELLED] = 0
    votes[..., CATEGORIES.index("road")] += 1
    return votes.argmax(-1)
