"""Figures 5 to 9 of finished runs, as matplotlib figures by their file names."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.views import view
from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.page.recording_pictures import semantic_picture
from sglpr_jax.evaluation.protocols.protocol import Result
from sglpr_jax.files import file_name
from sglpr_jax.reproduce.experiments import EXPERIMENTS, FULL, NO_SEGMENTATION
from sglpr_jax.reproduce.runs import Runs
from sglpr_jax.retrieval.heat_maps import heat_maps

if TYPE_CHECKING:
    import matplotlib.figure

Pictures = dict[str, "matplotlib.figure.Figure"]
HEAT_MAPS = ("decoder", "CBAM")


def precision_recall(results: Mapping[str, Mapping[str, Result]]) -> Pictures:
    """Figure 5: a plot for each recording with a line for each method. `results` are by recording and method."""
    pictures = {}
    for seq, of_method in results.items():
        curves = {method: result.curve for method, result in of_method.items() if result.curve is not None}
        if curves:
            pictures[f"figure5-{file_name(seq)}.png"] = figures.precision_recall(curves, title=seq)
    return pictures


def trajectories(runs: Runs, results: Mapping[str, Result]) -> Pictures:
    """Figure 6: a plot for each recording with the model's decisions along the trajectory."""
    pictures = {}
    for seq, result in results.items():
        positions = runs.recording(seq).positions
        if result.decisions is not None and positions is not None:
            pictures[f"figure6-{file_name(seq)}.png"] = figures.trajectory(positions, result.decisions, title=seq)
    return pictures


def semantic_maps(runs: Runs, seqs: Sequence[str]) -> Pictures:
    """Figure 7: a scan from the middle of each recording, labelled by the model that was not trained on the
    recording."""
    pictures = {}
    for seq in seqs:
        recording = runs.recording(seq)
        row = len(recording) // 2
        shown = semantic_picture(recording, runs.params(FULL, seq), row)
        pictures[f"figure7-{file_name(seq)}.png"] = figures.segmentation_panel(
            shown.counts,
            shown.truth,
            shown.predicted,
            resolution_m=shown.resolution_m,
            categories=shown.categories,
            title=f"{seq}, scan {recording.ids[row]}",
        )
    return pictures


def feature_heat_maps(runs: Runs, seq: str, recordings: Sequence[Recording]) -> Pictures:
    """Figure 8: feature maps of a scan from the middle of each recording, without and with the segmentation branch.

    Both models were trained without `seq`.
    """
    models = {"without": runs.params(NO_SEGMENTATION, seq), "with": runs.params(FULL, seq)}
    pictures = {}
    for recording in recordings:
        row = len(recording) // 2
        model = runs.config.model
        image = np.asarray(view(recording.record(row, labels=False), model.grid, image=model.image).image)
        maps = {
            f"{name}: {layer}": values
            for name, params in models.items()
            for layer, values in heat_maps(params, image).items()
            if layer in HEAT_MAPS
        }
        title = f"{recording.name}, scan {recording.ids[row]}, without and with the segmentation branch"
        pictures[f"figure8-{file_name(recording.name)}.png"] = figures.heat_maps(image, maps, title=title)
    return pictures


def categories(score: Callable[[str, str], float], seqs: Sequence[str]) -> Pictures:
    """Figure 9: the score of every recording over the number of categories. `score(variant, seq)` returns a score."""
    numbers = EXPERIMENTS["figure9"].names()
    curves = {seq: [(int(number), score(variant, seq)) for variant, number in numbers.items()] for seq in seqs}
    plot = figures.learning_curve(curves, xlabel="categories", ylabel="top-1 F1max")
    return {"figure9.png": plot}
