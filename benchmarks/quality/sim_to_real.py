"""What weights trained in the simulator know of real scans: their semantics, and their places."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.quality.range_images import range_image_paths, read_range_image
from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.recording import Record
from sglpr_jax.evaluation.figures import save, segmentation_panel
from sglpr_jax.evaluation.report import to_json
from sglpr_jax.evaluation.scoring import score
from sglpr_jax.evaluation.segmentation import SegmentationResult, confusion_matrix, score_confusion
from sglpr_jax.labels import CATEGORIES, UNLABELLED, to_raw
from sglpr_jax.methods.registry import handcrafted, network
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import init
from sglpr_jax.models.weights_file import load
from sglpr_jax.retrieval.embed import embed
from sglpr_jax.retrieval.image_maps import SemanticMap, semantic_map

ROTATION_SEED = 0


@dataclasses.dataclass(frozen=True)
class Semantics:
    """Mean IoU on real labelled scans, beside the commonest class, and each cell's commonest class in the simulator."""

    weights: str
    out: Path
    """Folder of semantics.json and of the picture (it shows a real scan, which KITTI's licence keeps private)."""
    prior: Path
    """The simulated dataset from which each cell's commonest class is taken."""
    scans: tuple[Path, ...] = ()
    """Datasets in KITTI's layout; their labelled scans are scored."""
    range_images: Path | None = None
    """A folder of labelled range images."""
    prior_scans: int = 30
    """Scans of each simulated recording that make the prior."""


@dataclasses.dataclass(frozen=True)
class Places:
    """Every protocol on real ready-made images, raw and turned, beside untrained weights and polar-FFT."""

    weights: str
    out: Path
    """The JSON file to write."""
    images: Path
    """A dataset in BEVPlace's layout."""
    seqs: tuple[str, ...] = ("00", "02", "06")


def semantics(command: Semantics) -> None:
    """Score every real scan with labels, together and source by source."""
    params = load(command.weights)
    command.out.mkdir(parents=True, exist_ok=True)
    prior = _commonest_by_cell(params, command.prior, command.prior_scans)
    classes = params.config.classes
    trained, by_cell = {}, {}
    for source, scan in _labelled_scans(command):
        found = semantic_map(params, scan)
        if source not in trained:
            trained[source], by_cell[source] = np.zeros((2, classes, classes), np.int64)
            panel = segmentation_panel(
                found.counts, found.truth, found.predicted, resolution_m=params.config.grid.resolution_m
            )
            save(panel, command.out / f"{source.replace(' ', '-')}.png")
        for total, prediction in ((trained, found.predicted), (by_cell, prior)):
            total[source] += confusion_matrix(found.truth, prediction, counted=found.seen, classes=classes)
    report = {}
    for source in [*trained, "all"]:
        ours, guess = (
            score_confusion(sum(total.values()) if source == "all" else total[source]) for total in (trained, by_cell)
        )
        report[source] = _scores(ours, guess)
        Console(width=120).print(_semantics_table(source, ours, guess))
    (command.out / "semantics.json").write_text(json.dumps(report, indent=2) + "\n")


def _labelled_scans(command: Semantics) -> Iterator[tuple[str, Record]]:
    """Source and record of every scan that has labels."""
    for root in command.scans:
        for name in recording_names(root):
            recording = open_recording(root, name)
            for row, labelled in enumerate(recording.labelled):
                if labelled and not recording.has_images:
                    yield f"scans of {name}", recording.record(row)
    for path in range_image_paths(command.range_images) if command.range_images else ():
        points, classes = read_range_image(path)
        yield f"range images of {path.stem[:2]}", Record(points=points, labels=to_raw(classes))


def _commonest_by_cell(params: Params, root: Path, scans: int) -> np.ndarray:
    """The commonest class of each cell (h, w) over simulated scans; road where none ever saw a point."""
    grid = params.config.grid
    votes = np.zeros((grid.height, grid.width, params.config.classes), np.int64)
    rows, columns = np.indices(votes.shape[:2])
    for name in recording_names(root):
        recording = open_recording(root, name)
        for row in np.linspace(0, len(recording) - 1, scans).astype(int):
            found: SemanticMap = semantic_map(params, recording.record(row))
            votes[rows, columns, found.truth] += 1
    votes[..., UNLABELLED] = 0
    votes[..., CATEGORIES.index("road")] += 1
    return votes.argmax(-1)


def _scores(ours: SegmentationResult, guess: SegmentationResult) -> dict:
    return {
        "mean_iou": ours.mean_iou,
        "commonest_class_by_cell_mean_iou": guess.mean_iou,
        "commonest_class_mean_iou": ours.majority_mean_iou,
        "iou": {CATEGORIES[i]: float(ours.iou[i]) for i in np.flatnonzero(ours.shares)},
        "shares": {CATEGORIES[i]: float(ours.shares[i]) for i in np.flatnonzero(ours.shares)},
        "cells": ours.cells,
    }


def _semantics_table(source: str, ours: SegmentationResult, guess: SegmentationResult) -> Table:
    table = Table("class", "share of the cells", "IoU", "IoU of each cell's commonest class", title=source)
    for i in np.flatnonzero(ours.shares):
        table.add_row(CATEGORIES[i], f"{ours.shares[i]:.2%}", f"{ours.iou[i]:.3f}", f"{guess.iou[i]:.3f}")
    table.add_section()
    table.add_row(f"mean of {ours.present} classes", "", f"{ours.mean_iou:.3f}", f"{guess.mean_iou:.3f}")
    table.add_row(f"{CATEGORIES[ours.majority]} everywhere", "", f"{ours.majority_mean_iou:.3f}", "")
    return table


def places(command: Places) -> None:
    """Embed every real image with the network and its references, and score by every protocol."""
    params = load(command.weights)
    report: dict = {}
    table = Table("sequence", "method", "turned", "top-1 F1max", "pairs F1max", "Recall@1")
    for seq in command.seqs:
        sequence = open_recording(command.images, seq)
        methods = {
            "trained in the simulator": network(params),
            "untrained": network(init(jax.random.key(1), config=params.config)),
            "polar-fft": handcrafted("polar-fft", sequence, params.config.grid),
        }
        for name, method in methods.items():
            for turned, seed in (("no", None), ("yes", ROTATION_SEED)):
                results = score(embed(method, sequence, rotation_seed=seed))
                report[f"{seq}, {name}, turned: {turned}"] = to_json(results)
                table.add_row(seq, name, turned, *(f"{result.score:.3f}" for result in results))
        table.add_section()
    command.out.write_text(json.dumps(report, indent=2) + "\n")
    Console(width=120).print(table)


Command = Annotated[Semantics, tyro.conf.subcommand("semantics")] | Annotated[Places, tyro.conf.subcommand("places")]


def main() -> None:
    """The entry point."""
    command = tyro.cli(Command, prog="sim_to_real.py", description=__doc__)
    semantics(command) if isinstance(command, Semantics) else places(command)


if __name__ == "__main__":
    main()
