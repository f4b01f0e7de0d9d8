"""Comparison of real and simulated scans: histograms, and semantics of real scans by simulated training."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import sglpr_jax
from benchmarks.table import Table
from sglpr_jax.bev import rasterize, rasterize_labels
from sglpr_jax.data.density_image import density_image, density_label_image
from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.evaluation.figures import save
from sglpr_jax.evaluation.segmentation import confusion_matrix, draw_map, score_confusion
from sglpr_jax.grid import DENSITY_MAX_COUNT, DENSITY_RESOLUTION_M
from sglpr_jax.labels import CATEGORIES, UNLABELLED, to_classes, to_raw
from sglpr_jax.models.config import model_preset
from sglpr_jax.models.weights import Params
from sglpr_jax.retrieval.image_maps import semantic_map

GRID = model_preset("sglpr").grid

Measures = Mapping[str, np.ndarray]
"""Histograms by their names in `HISTOGRAMS`, each as fractions of its bins."""

_RANGES = (0, 3, 5, 7.5, 10, 15, 20, 30, 40, 60, 80)
_HEIGHTS = (-np.inf, -2.4, -2, -1.8, -1.6, -1.4, -1.2, -0.8, -0.4, 0, 0.5, 1, 1.5, 2, 3, np.inf)
_COUNTS = (1, 2, 3, 5, 9, 17, 33, 65, np.inf)
_DISTANCES = (0, 5, 7.5, 10, 12.5, 15, 17.5, 20, 25, 36)
_LATERALS = (0, *np.arange(1.8, 20, 2), 25.4)  # five rows of pixels each, but for the first and the last
_BINS = {
    "range": ("points by range, m", _RANGES),
    "height": ("points by height over the sensor, m", _HEIGHTS),
    "count": ("occupied cells by points in them", _COUNTS),
    "image_density": ("density image: pixels above 0 by value, tenths", np.arange(0.5, 11)),
    "image_distance": ("density image: pixels above 0 by distance, m", _DISTANCES),
    "image_lateral": ("density image: pixels above 0 by distance to the side, m", _LATERALS),
}


def _bin_names(edges: Sequence[float]) -> tuple[str, ...]:
    return tuple(f"{low:g} to {high:g}" for low, high in itertools.pairwise(edges))


HISTOGRAMS = {name: (title, _bin_names(edges)) for name, (title, edges) in _BINS.items()} | {
    "class_of_points": ("points by class", CATEGORIES),
    "class_of_cells": ("occupied cells by class", CATEGORIES),
    "class_of_pixels": ("density image's window: cells by class", CATEGORIES),
}
"""Title and names of the bins of every histogram. A bin includes its lower edge and excludes its upper edge."""


def compare(
    *,
    out: Path,
    real: tuple[Path, ...] = (),
    real_range: Path | None = None,
    simulated: tuple[Path, ...] = (),
    scans: int = 30,
) -> None:
    """Measure real and simulated drives; print how far their histograms are apart, and write histograms.png.

    Args:
        out: folder of the picture.
        real: datasets of real scans, or of density images in BEVPlace's layout.
        real_range: folder of labelled range images, NN_FFFFFF.npz with `points` and `label` (learning classes).
        simulated: datasets that bin/simulate made.
        scans: the most scans of a drive that are measured, evenly spread over it.
    """
    sources = dict(one for root in real for one in _measured("real", root, scans))
    sources |= dict(_measured_range_images(real_range)) if real_range else {}
    sources |= dict(one for root in simulated for one in _measured("simulated", root, scans))
    if not sources:
        raise SystemExit("nothing to measure: name datasets with --real, --real-range or --simulated")
    table = Table("total variation from the real drives, %", *sources)
    for measure, (title, _) in HISTOGRAMS.items():
        table.add(title, *(_distance_from_real(name, measure, sources) for name in sources))
    save(_draw(sources), out / "histograms.png")
    print(out / "histograms.png")


def _measured(kind: str, root: Path, scans: int) -> Iterator[tuple[str, Measures]]:
    """Mean measures of each drive of a dataset."""
    for name in recording_names(root):
        drive = open_recording(root, name)
        rows = np.unique(np.linspace(0, len(drive) - 1, min(scans, len(drive))).astype(int)).tolist()
        what = "images" if drive.has_images else "scans"
        yield f"{kind} {what} {name}", _mean([_measures(drive, row) for row in rows])


def _measures(drive: Recording, row: int) -> Measures:
    """Histograms of one scan or image."""
    if drive.has_images:
        return _image_measures(np.rint(drive.image(row) * (255 / DENSITY_MAX_COUNT)).astype(np.uint8))
    labels = drive.labels(row)
    return _scan_measures(drive.points(row), None if labels is None else to_classes(labels))


def _measured_range_images(folder: Path) -> Iterator[tuple[str, Measures]]:
    """Mean measures of each drive of a folder of range images."""
    for name, images in itertools.groupby(_range_images(folder), key=lambda image: image[0]):
        yield f"real range images {name}", _mean([_scan_measures(points, classes) for _, points, classes in images])


def _mean(of_scans: Sequence[Measures]) -> Measures:
    """Mean of each histogram over the scans that have it."""
    names = dict.fromkeys(name for measures in of_scans for name in measures)
    return {name: np.mean([measures[name] for measures in of_scans if name in measures], axis=0) for name in names}


def _distance_from_real(name: str, measure: str, sources: Mapping[str, Measures]) -> str:
    """Total variation in percent between a drive's histogram and the mean of all (other) real drives, or ""."""
    others = [measures for other, measures in sources.items() if other.startswith("real") and other != name]
    histograms = [measures[measure] for measures in others if measure in measures]
    if measure not in sources[name] or not histograms:
        return ""
    return f"{50 * np.abs(sources[name][measure] - np.mean(histograms, axis=0)).sum():.0f}"


def _draw(sources: Mapping[str, Measures]) -> Figure:
    """One panel for each histogram: real drives in grey, simulated ones in colours."""
    figure = Figure(figsize=(15, 12), layout="constrained")
    dashes = itertools.cycle(("-", "--", "-.", ":"))
    styles = {
        name: {"color": "0.4", "linestyle": next(dashes)} if name.startswith("real") else {"linewidth": 2}
        for name in sources
    }
    for axes, (measure, (title, bins)) in zip(figure.subplots(3, 3).flat, HISTOGRAMS.items(), strict=True):
        for name, measures in sources.items():
            values = 100 * measures.get(measure, np.full(len(bins), np.nan))
            axes.plot(values, marker="o", markersize=3, label=name, **styles[name])
        axes.set_title(f"{title}, %", fontsize=10)
        axes.set_xticks(range(len(bins)), bins, rotation=60, ha="right", fontsize=7)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return figure


def _scan_measures(points: np.ndarray, classes: np.ndarray | None) -> Measures:
    """All histograms of a scan (n, 3) in metres, those of classes only if `classes` is not None."""
    padding = (0, (1 << len(points).bit_length()) - len(points))  # few sizes, so few compilations
    padded, count = jnp.asarray(np.pad(points, (padding, (0, 0)))), jnp.asarray(len(points))
    counts = np.asarray(rasterize(padded, grid=GRID, count=count))
    measures = {
        "range": _histogram("range", np.linalg.norm(points, axis=1)),
        "height": _histogram("height", points[:, 2]),
        "count": _histogram("count", counts[counts > 0]),
        **_image_measures(np.rot90(density_image(points), -1)),
    }
    if classes is None:
        return measures
    cells = np.asarray(rasterize_labels(padded, jnp.asarray(np.pad(classes, padding)), grid=GRID, count=count))
    return measures | {
        "class_of_points": _share_of_classes(classes),
        "class_of_cells": _share_of_classes(cells[counts > 0]),
        "class_of_pixels": _share_of_classes(density_label_image(points, classes)),
    }


def _image_measures(image: np.ndarray) -> Measures:
    """Histograms of a density image (151, 151) of grey values, in the orientation of the paper's equation 1."""
    half = image.shape[0] // 2
    rows, columns = np.nonzero(image)
    x, y = (columns - half) * DENSITY_RESOLUTION_M, (half - rows) * DENSITY_RESOLUTION_M
    return {
        "image_density": _histogram("image_density", image[rows, columns] / 25.5),
        "image_distance": _histogram("image_distance", np.hypot(x, y)),
        "image_lateral": _histogram("image_lateral", np.abs(y)),
    }


def _histogram(name: str, values: np.ndarray) -> np.ndarray:
    _, edges = _BINS[name]
    counts = np.histogram(values, bins=edges)[0]
    return counts / max(counts.sum(), 1)


def _share_of_classes(classes: np.ndarray) -> np.ndarray:
    """Fraction of each class among the labelled points or cells."""
    counts = np.bincount(classes.ravel(), minlength=len(CATEGORIES))
    counts[0] = 0  # class 0 is unlabelled
    return counts / max(counts.sum(), 1)


def _range_images(folder: Path) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Drive, points (n, 3) in metres and class of each point (n,) of the files of a folder."""
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise SystemExit(f"{folder}: expected range images (*.npz), found none")
    for path in paths:
        with np.load(path, allow_pickle=False) as file:
            yield path.stem[:2], np.ascontiguousarray(file["points"][:, :3]), file["label"].astype(np.int32)


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
        range_images: folder of labelled range images.
        prior_scans: scans of each simulated recording that make the prior.
    """
    params = sglpr_jax.load(weights)
    by_cell, classes = _commonest_by_cell(params, prior, prior_scans), params.config.classes
    totals: dict[str, np.ndarray] = {}
    for source, scan in _labelled_scans(scans, range_images):
        found = semantic_map(params, scan)
        if source not in totals:
            save(draw_map(found, params.config), out / f"{source.replace(' ', '-')}.png")
        each = [
            confusion_matrix(found.truth, one, counted=found.seen, classes=classes)
            for one in (found.predicted, by_cell)
        ]
        totals[source] = totals.get(source, 0) + np.stack(each)
    totals["all"] = np.sum(list(totals.values()), axis=0)
    for source, matrices in totals.items():
        ours, guess = map(score_confusion, matrices)
        table = Table(source, "share of the cells", "IoU", "IoU of each cell's commonest class")
        for i in np.flatnonzero(ours.shares).tolist():
            table.add(CATEGORIES[i], f"{ours.shares[i]:.2%}", f"{ours.iou[i]:.3f}", f"{guess.iou[i]:.3f}")
        table.add(f"mean of {ours.n_present} classes", "", f"{ours.mean_iou:.3f}", f"{guess.mean_iou:.3f}")
        table.add(f"{ours.majority} everywhere", "", f"{ours.majority_mean_iou:.3f}", "")


def _labelled_scans(roots: tuple[Path, ...], range_images: Path | None) -> Iterator[tuple[str, Scan]]:
    """Source and record of every scan that has labels."""
    for root in roots:
        for name in recording_names(root):
            recording = open_recording(root, name)
            for row, labelled in enumerate(recording.labelled):
                if labelled and not recording.has_images:
                    yield f"scans of {name}", recording.scan(row)
    for name, points, classes in _range_images(range_images) if range_images else ():
        yield f"range images of {name}", Scan(points=points, labels=to_raw(classes))


def _commonest_by_cell(params: Params, root: Path, scans: int) -> np.ndarray:
    """Most frequent class of each cell (h, w) in simulated scans, or road where no scan has a point."""
    grid = params.config.grid
    votes = np.zeros((grid.height, grid.width, params.config.classes), np.int64)
    rows, columns = np.indices(votes.shape[:2])
    for name in recording_names(root):
        recording = open_recording(root, name)
        for row in np.linspace(0, len(recording) - 1, scans).astype(int):
            found = semantic_map(params, recording.scan(row))
            votes[rows, columns, found.truth] += 1
    votes[..., UNLABELLED] = 0
    votes[..., CATEGORIES.index("road")] += 1
    return votes.argmax(-1)
