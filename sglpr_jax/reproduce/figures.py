"""Draws figures 5 to 9 of the paper from finished training runs."""

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
"""Yields the pictures of a figure with the name of their recording, which is empty for a picture of all recordings."""
HEAT_MAPS = ("decoder", "CBAM")
"""Names of the layers in figure 8."""


def precision_recall(reproduction: Reproduction) -> Figures:
    """Figure 5: a plot for each recording with a precision-recall curve for each method."""
    for seq in reproduction.seqs:
        curves = {}
        for method, label in reproduction.labels("figure5").items():
            curve = reproduction.score(method, seq).curve
            if curve is not None:  # None without a revisit
                curves[label] = curve
        if curves:
            yield seq, figures.precision_recall(curves, title=seq)


def trajectories(reproduction: Reproduction) -> Figures:
    """Figure 6: a plot for each recording with the model's decisions along the trajectory."""
    for seq in reproduction.seqs:
        positions = reproduction.recording(seq).positions
        decisions = reproduction.score(FULL, seq).decisions
        if decisions is not None and positions is not None:
            yield seq, figures.trajectory(positions, decisions, title=seq)


def semantic_maps(reproduction: Reproduction) -> Figures:
    """Figure 7: a scan from the middle of each recording, labelled by the model that was not trained on it."""
    for seq in reproduction.seqs:
        recording, params = reproduction.recording(seq), reproduction.params(FULL, seq)
        row = len(recording) // 2
        semantic = semantic_map(params, recording.scan(row))
        title = f"{seq}, scan {recording.ids[row]}"
        yield seq, draw_map(semantic, params.config, labelled=bool(recording.labelled[row]), title=title)


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
        maps = {}
        for name, params in models.items():
            layers = heat_maps(params, image).items()
            maps |= {f"{name}: {layer}": heat_map for layer, heat_map in layers if layer in HEAT_MAPS}
        title = f"{recording.name}, scan {recording.ids[row]}, without and with the segmentation branch"
        yield recording.name, figures.heat_maps(image, maps, title=title)


def categories(reproduction: Reproduction) -> Figures:
    """Figure 9: the score of every recording over the number of categories."""
    variants = EXPERIMENTS["figure9"].variants.items()  # the labels are the numbers of categories
    curves = {
        seq: [(int(label), reproduction.score(variant, seq).score) for variant, label in variants]
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
    """Draw all pictures of a figure, then write them. Returns their paths."""
    paths = []
    for seq, figure in list(FIGURES[name](reproduction)):
        suffix = f"-{file_name(seq)}" if seq else ""
        paths.append(reproduction.folder / f"{name}{suffix}.png")
        figures.save(figure, paths[-1])
    return paths
