"""Figures 5 to 9 of finished runs."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.views import view
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.evaluation_page import semantic_figure
from sglpr_jax.files import file_name
from sglpr_jax.reproduce.experiments import EXPERIMENTS, FULL, NO_SEGMENTATION
from sglpr_jax.reproduce.tables import Reproduction, scored
from sglpr_jax.retrieval.image_maps import heat_maps

if TYPE_CHECKING:
    import matplotlib.figure

Figures = Iterator[tuple[str, "matplotlib.figure.Figure"]]
"""Pictures of a figure, by the name of a recording, or by an empty name."""
HEAT_MAPS = ("decoder", "CBAM")


def precision_recall(found: Reproduction) -> Figures:
    """Figure 5: a plot for each recording with a line for each method."""
    for seq in found.seqs:
        results = {label: scored(found.runs, method, seq) for method, label in found.labels("figure5").items()}
        curves = {label: result.curve for label, result in results.items() if result.curve is not None}
        if curves:
            yield seq, figures.precision_recall(curves, title=seq)


def trajectories(found: Reproduction) -> Figures:
    """Figure 6: a plot for each recording with the model's decisions along the trajectory."""
    for seq in found.seqs:
        positions, decisions = found.runs.recording(seq).positions, scored(found.runs, FULL, seq).decisions
        if decisions is not None and positions is not None:
            yield seq, figures.trajectory(positions, decisions, title=seq)


def semantic_maps(found: Reproduction) -> Figures:
    """Figure 7: a scan from the middle of each recording, labelled by the model that was not trained on it."""
    for seq in found.seqs:
        recording = found.runs.recording(seq)
        row = len(recording) // 2
        title = f"{seq}, scan {recording.ids[row]}"
        yield seq, semantic_figure(recording, found.runs.params(FULL, seq), row, title=title)


def feature_heat_maps(found: Reproduction) -> Figures:
    """Figure 8: feature maps of two scans by models without and with the segmentation branch.

    The scans are from the middle of the first test recording, without which both models were trained, and from the
    middle of the last session.
    """
    runs, seq, root, model = found.runs, found.seqs[0], found.sessions(), found.runs.config.model
    models = {"without": runs.params(NO_SEGMENTATION, seq), "with": runs.params(FULL, seq)}
    for recording in (runs.recording(seq), open_recording(root, recording_names(root)[-1])):
        row = len(recording) // 2
        image = np.asarray(view(recording.scan(row, labels=False), model.grid, image=model.image).image)
        maps = {
            f"{name}: {layer}": values
            for name, params in models.items()
            for layer, values in heat_maps(params, image).items()
            if layer in HEAT_MAPS
        }
        title = f"{recording.name}, scan {recording.ids[row]}, without and with the segmentation branch"
        yield recording.name, figures.heat_maps(image, maps, title=title)


def categories(found: Reproduction) -> Figures:
    """Figure 9: the score of every recording over the number of categories."""
    variants = EXPERIMENTS["figure9"].names()
    curves = {
        seq: [(int(number), scored(found.runs, variant, seq).score) for variant, number in variants.items()]
        for seq in found.seqs
    }
    yield "", figures.learning_curves({"top-1 F1max": curves}, xlabel="categories")


FIGURES: Mapping[str, Callable[[Reproduction], Figures]] = {
    "figure5": precision_recall,
    "figure6": trajectories,
    "figure7": semantic_maps,
    "figure8": feature_heat_maps,
    "figure9": categories,
}


def write_figures(name: str, found: Reproduction, folder: Path) -> list[Path]:
    """Draw and write the pictures of a figure. Returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    drawn = {folder / f"{name}{seq and f'-{file_name(seq)}'}.png": figure for seq, figure in FIGURES[name](found)}
    for path, figure in drawn.items():
        figures.save(figure, path)
    return list(drawn)
