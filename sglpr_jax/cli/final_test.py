"""The test after a training: the drive never seen, raw and with every scan turned, beside methods without training."""

import dataclasses
import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from sglpr_jax.bev import rasterize, rasterize_labels
from sglpr_jax.cli.methods import Method, network, reference
from sglpr_jax.cli.runtime import console, progress_bar, write_json
from sglpr_jax.data import Drive, ScanSequence
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.protocols import Result
from sglpr_jax.evaluation.report import comparison, evaluate, table, to_json
from sglpr_jax.evaluation.segmentation import UNLABELLED, SegmentationResult, score_segmentation
from sglpr_jax.labels import CATEGORIES, to_classes
from sglpr_jax.models.sglpr import Params, field_of_view, init, segment

ROTATION_SEED = 0
TRAINED = "sglpr"
_POINTS_STEP = 16384
"""Clouds are padded to a multiple of this, so that few sizes are compiled."""


def final_test(params: Params, sequence: Drive, folder: Path, *, seed: int) -> None:
    """Embed, score, print and draw; everything that is printed is also written into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    untrained = init(jax.random.key(seed + 1), config=params.config)
    methods = {
        TRAINED: network(params),
        "untrained": network(untrained),
        "thumbnail": reference("thumbnail", sequence, params.config.grid),
        "polar-fft": reference("polar-fft", sequence, params.config.grid),
    }
    report: dict = {"sequence": sequence.name}
    for title, rotation_seed in (("raw", None), ("rotated", ROTATION_SEED)):
        results = _score(methods, sequence, folder, title, rotation_seed)
        report[title] = {name: to_json(scored) for name, scored in results.items()}
        _print(results, f"sequence {sequence.name}, {title}")
        if importlib.util.find_spec("matplotlib"):
            _draw(results, sequence, folder, title)
    if isinstance(sequence, ScanSequence) and sequence.has_labels:
        report["segmentation"] = _test_segmentation(params, sequence, folder)
    write_json(folder / "results.json", report)
    console().print(f"written to {folder}")


def _score(
    methods: dict[str, Method],
    sequence: Drive,
    folder: Path,
    title: str,
    rotation_seed: int | None,
) -> dict[str, list[Result]]:
    results = {}
    for name, method in methods.items():
        with progress_bar(f"embed {title} {name}", len(sequence)) as show:
            file = method.embed(sequence, rotation_seed=rotation_seed, on_progress=show)
        file.save(folder / f"{name}-{title}.npz")
        results[name] = evaluate(file)
    return results


def _print(results: dict[str, list[Result]], title: str) -> None:
    console().print(table(results[TRAINED], title=f"{title}: {TRAINED}"))
    console().print(comparison(results, title=title))


def _draw(results: dict[str, list[Result]], sequence: Drive, folder: Path, title: str) -> None:
    top1 = {name: scored[0] for name, scored in results.items()}
    curves = {name: result.curve for name, result in top1.items() if result.curve is not None}
    if curves:  # none where the drive has no revisit
        picture = figures.precision_recall(curves, title=f"{sequence.name}, {title}: top-1")
        figures.save(picture, folder / f"precision-recall-{title}.png")
    decisions = top1[TRAINED].decisions
    if decisions is not None and sequence.positions is not None:
        figures.save(figures.trajectory(sequence.positions, decisions), folder / f"trajectory-{title}.png")


def _test_segmentation(params: Params, sequence: ScanSequence, folder: Path) -> dict:
    """Score the segmentation head on every labelled scan; draw input, truth and prediction of one (figure 7)."""
    rows = [row for row, path in enumerate(sequence.label_paths) if path is not None]
    maps = [_maps(params, sequence, row) for row in rows]
    counts, truth, prediction = (np.stack(part) for part in zip(*maps, strict=True))
    seen = (counts > 0) & field_of_view(params.config)
    result = score_segmentation(truth, prediction, counted=seen, classes=params.config.classes)
    console().print(
        f"segmentation of {len(rows)} scans: mean IoU {result.mean_iou:.3f}; "
        f"predicting {CATEGORIES[result.majority]} everywhere: {result.majority_mean_iou:.3f}",
    )
    if importlib.util.find_spec("matplotlib"):
        middle = len(rows) // 2
        shown = np.where(seen[middle], prediction[middle], 0)
        panel = figures.segmentation_panel(
            counts[middle], truth[middle] * seen[middle], shown, resolution_m=params.config.grid.resolution_m
        )
        figures.save(panel, folder / "segmentation.png")
    return _segmentation_json(result)


def _maps(params: Params, sequence: ScanSequence, row: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Point counts, true classes and predicted classes of one scan."""
    points, labels = sequence.points(row), sequence.labels(row)
    assert labels is not None
    padding = -len(points) % _POINTS_STEP
    padded = np.pad(points, ((0, padding), (0, 0))), np.pad(to_classes(labels), (0, padding))
    counts, truth, prediction = jax.device_get(_maps_of_cloud(params, *padded, jnp.int32(len(points))))
    return counts, truth, prediction


@jax.jit
def _maps_of_cloud(params: Params, points, classes, count):
    grid = params.config.grid
    counts = rasterize(points, grid=grid, count=count)
    truth = rasterize_labels(points, classes, grid=grid, count=count)
    known = segment(params, counts)[..., UNLABELLED + 1 :]  # a cell with points in it is not "unlabelled"
    return counts, truth, known.argmax(-1) + UNLABELLED + 1


def _segmentation_json(result: SegmentationResult) -> dict:
    iou = {name: None if np.isnan(x) else float(x) for name, x in zip(CATEGORIES, result.iou, strict=True)}
    return {
        **dataclasses.asdict(result),
        "mean_iou": result.mean_iou,
        "majority": CATEGORIES[result.majority],
        "iou": iou,
    }
