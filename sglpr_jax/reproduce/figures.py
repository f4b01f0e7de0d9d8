"""Figures 5 to 9 of finished runs."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sglpr_jax.data.views import view
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.segmentation import draw_map
from sglpr_jax.files import file_name
from sglpr_jax.reproduce.experiments import EXPERIMENTS, FULL, NO_SEGMENTATION
from sglpr_jax.reproduce.reproduction import Reproduction
from sglpr_jax.retrieval.image_maps import heat_maps, semantic_map

if TYPE_CHECKING:
    import matplotlib.figure

Figures = Iterator[tuple[str, "matplotlib.figure.Figure"]]
"""Pictures of a figure, by the name of a recording, or by an empty name."""
HEAT_MAPS = ("decoder", "CBAM")


def precision_recall(reproduction: Reproduction) -> Figures:
    """Figure 5: a plot for each recording with a line for each method."""
    for seq in reproduction.seqs:
        labels = reproduction.labels("figure5").items()
        curves = {label: reproduction.score(method, seq).curve for method, label in labels}
        lines = {label: curve for label, curve in curves.items() if curve is not None}
        if lines:
            yield seq, figures.precision_recall(lines, title=seq)


def trajectories(reproduction: Reproduction) -> Figures:
    """Figure 6: a plot for each recording with the model's decisions along the trajectory."""
    for seq in reproduction.seqs:
        positions, decisions = reproduction.recording(seq).positions, reproduction.score(FULL, seq).decisions
        if decisions is not None and positions is not None:
            yield seq, figures.trajectory(positions, decisions, title=seq)


def semantic_maps(reproduction: Reproduction) -> Figures:
    """Figure 7: a scan from the middle of each recording, labelled by the model that was not trained on it."""
    for seq in reproduction.seqs:
        recording, params = reproduction.recording(seq), reproduction.params(FULL, seq)
        row = len(recording) // 2
        semantic, labelled = semantic_map(params, recording.scan(row)), bool(recording.labelled[row])
        title = f"{seq}, scan {recording.ids[row]}"
        yield seq, draw_map(semantic, params.config, labelled=labelled, title=title)


def feature_heat_maps(reproduction: Reproduction) -> Figures:
    """Figure 8: feature maps of two scans by models without and with the segmentation branch.

    The scans are from the middle of the first test recording, without which both models were trained, and from the
    middle of the last session.
    """
    seq, model = reproduction.seqs[0], reproduction.config.model
    models = {"without": reproduction.params(NO_SEGMENTATION, seq), "with": reproduction.params(FULL, seq)}
    for recording in (reproduction.recording(seq), reproduction.session_recordings()[-1]):
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


def categories(reproduction: Reproduction) -> Figures:
    """Figure 9: the score of every recording over the number of categories."""
    variants = EXPERIMENTS["figure9"].variants.items()
    curves = {
        seq: [(int(number), reproduction.score(variant, seq).score) for variant, number in variants]
        for seq in reproduction.seqs
    }
    yield "", figures.learning_curves({"top-1 F1max": curves}, xlabel="categories")


FIGURES: Mapping[str, Callable[[Reproduction], Figures]] = {
    "figure5": precision_recall,
    "figure6": trajectories,
    "figure7": semantic_maps,
    "figure8": feature_heat_maps,
    "figure9": categories,
}


def write_figures(reproduction: Reproduction, name: str) -> list[Path]:
    """Draw and write the pictures of a figure. Returns their paths."""
    paths = []
    for seq, figure in list(FIGURES[name](reproduction)):
        paths.append(reproduction.folder / f"{name}{seq and f'-{file_name(seq)}'}.png")
        figures.save(figure, paths[-1])
    return paths
