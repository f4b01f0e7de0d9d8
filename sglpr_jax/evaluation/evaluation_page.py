"""Folder of an evaluation: its numbers as JSON, its plots, and a page with all of them."""

import functools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sglpr_jax.evaluation import figures, report
from sglpr_jax.evaluation.page import (
    PicturePairs,
    Section,
    Text,
    bev_picture,
    figure_picture,
    missing,
    render,
)
from sglpr_jax.evaluation.protocols.protocol import Result
from sglpr_jax.evaluation.scan_pictures import Pictures
from sglpr_jax.evaluation.scoring import Evaluation
from sglpr_jax.evaluation.sessions import PUBLISHED_NOTE, AcrossSessions
from sglpr_jax.files import file_name, json_text, read_json, text_bytes, write_all

if TYPE_CHECKING:
    import matplotlib.figure

Plots = dict[str, "matplotlib.figure.Figure"]
"""Figures by file name."""
NUMBERS = "results.json"
PAGE = "report.html"
CURVES = "precision-recall.png"
TRAJECTORY = "trajectory.png"
NO_MATPLOTLIB = "Drawings: install the extra viz (pip install 'sglpr-jax[viz]')."
INTERVALS = (
    "95 %: bootstrap interval over the queries. Published on: poses of the published numbers of the protocol;"
    " scores on other poses differ."
)


def write_evaluation(found: Evaluation, folder: Path, pictures: Pictures | None = None) -> list[Path]:
    """Write numbers, plots and page to `folder`. Without matplotlib no plots are written.

    Plots of an earlier evaluation in the folder are removed.

    Arguments:
      found: Results to write.
      folder: Output folder. It is created if needed.
      pictures: Images of a dataset and a model, by frame.

    Returns:
      The paths written.
    """
    curves, trajectory = (draw_curves(found), draw_trajectory(found)) if figures.can_draw() else ({}, {})
    html = evaluation_page(found, curves=curves, trajectory=trajectory, pictures=pictures or Pictures())
    return _write(folder, found.to_json(), curves | trajectory, html)


def write_sessions(found: AcrossSessions, folder: Path) -> list[Path]:
    """Write numbers and page of an evaluation across sessions. Otherwise as `write_evaluation`."""
    note = [Text(PUBLISHED_NOTE, "about")] if found.published else []
    html = render(found.title, found.about, [Section("Sessions", [found.table(), *note]), _results(found.results)])
    return _write(folder, found.to_json(), {}, html)


def _write(folder: Path, numbers: Mapping[str, Any], plots: Plots, html: str) -> list[Path]:
    """Replace an earlier evaluation in the folder, completely or not at all. Returns the paths written."""
    earlier = _earlier_plots(folder)
    drawn = {name: functools.partial(figures.write, figure) for name, figure in plots.items()}
    texts = {NUMBERS: json_text(numbers), PAGE: html}
    said = {name: functools.partial(Path.write_bytes, data=text_bytes(text)) for name, text in texts.items()}
    written = write_all(folder, {NUMBERS: said[NUMBERS], **drawn, PAGE: said[PAGE]})
    for name in earlier - set(plots):
        (folder / name).unlink(missing_ok=True)
    return written


def _earlier_plots(folder: Path) -> set[str]:
    """Return the possible file names of plots in an evaluation folder. Empty if it has no evaluation results."""
    try:
        results = [result["protocol"] for result in read_json(folder / NUMBERS)["results"]]
        return {CURVES, TRAJECTORY, *map(_curves_name, results)}
    except (OSError, ValueError, LookupError, TypeError, AttributeError):  # missing, damaged, or from another command
        return set()


def draw_curves(found: Evaluation) -> Plots:
    """Draw precision-recall curves.

    A single method gets one plot with a line for each protocol. Several methods get one plot for each protocol, with a
    line for each method.
    """
    if len(found.methods) == 1:
        curves = {result.name: result.curve for result in found.results if result.curve is not None}
        return {CURVES: figures.precision_recall(curves, title=found.title)} if curves else {}
    plots = {}
    for of_one in zip(*found.methods.values(), strict=True):
        pairs = zip(found.methods, of_one, strict=True)
        curves = {method: result.curve for method, result in pairs if result.curve is not None}
        if curves:
            plots[_curves_name(of_one[0].name)] = figures.precision_recall(curves, title=of_one[0].name)
    return plots


def draw_trajectory(found: Evaluation) -> Plots:
    """Draw the trajectory with the decisions of the first protocol that has decisions."""
    for result in found.results:
        if found.positions is not None and result.decisions is not None:
            return {TRAJECTORY: figures.trajectory(found.positions, result.decisions, title=result.name)}
    return {}


def _curves_name(result: str) -> str:
    """Return the file name of the plot of several methods by one protocol."""
    return f"precision-recall-{file_name(result.lower().replace(' ', '-').replace(':', '-'))}.png"


def evaluation_page(found: Evaluation, *, curves: Plots, trajectory: Plots, pictures: Pictures) -> str:
    """Return the page as HTML. If a section cannot be filled, one line names the option that adds it."""
    drawn = figures.can_draw()
    sections = [_results(found.results)]
    if len(found.methods) > 1:
        sections.append(Section("Methods side by side", [report.comparison(found.methods)]))
    if found.published:  # apart from our results: these are of real KITTI and by several protocols
        table = report.published_table(found.published)
        sections.append(Section("Published numbers", [table, Text(report.PUBLISHED_NOTE, "about")]))
    no_curve = "No protocol of this evaluation has a curve." if drawn else NO_MATPLOTLIB
    no_decisions = (
        "Decisions along the recording: add --poses, and a protocol that answers queries (--protocol top1-f1max)."
        if drawn
        else NO_MATPLOTLIB
    )
    activation = Text("Activation strength of each layer: root mean square over the channels.")
    return render(
        found.title,
        found.about,
        [
            *sections,
            _figures("Precision and recall", curves.values(), "precision over recall", nothing=no_curve),
            _figures("Trajectory", trajectory.values(), "every frame, coloured by its decision", nothing=no_decisions),
            _false_positives(found, pictures.images),
            _maps("Semantic maps", pictures.semantic if drawn else NO_MATPLOTLIB, "semantic map of"),
            _maps("Feature heat maps", pictures.heat if drawn else NO_MATPLOTLIB, "feature heat maps of", activation),
        ],
    )


def _results(results: Sequence[Result]) -> Section:
    """Tables of one method: rule, score, interval, counts and poses of every protocol, and thresholds."""
    table = report.results_table(results, published_on=True)
    return Section("Results", [table, Text(INTERVALS, "about"), report.threshold_table(results)])


def _figures(title: str, plots: "Iterable[matplotlib.figure.Figure]", name: str, *, nothing: str) -> Section:
    return Section(title, [figure_picture(plot, name) for plot in plots] or [missing(nothing)])


def _maps(title: str, found: "Mapping[str, matplotlib.figure.Figure] | str", name: str, *before: Text) -> Section:
    if isinstance(found, str):
        return Section(title, [missing(found)])
    drawn = [figure_picture(one, f"{name} frame {frame}", caption=f"frame {frame}") for frame, one in found.items()]
    return Section(title, [*before, *drawn])


def _false_positives(found: Evaluation, images: Mapping[int, np.ndarray]) -> Section:
    """Wrong answers with the smallest descriptor distance, as pairs of images if these are given."""
    title, judged = "Worst false positives", found.judged
    if judged is None:
        needs = "Wrong answers: add a protocol that applies a threshold (--protocol top1-f1max)."
        return Section(title, [missing(needs)])
    if not found.worst:
        return Section(title, [Text(f"{judged.name}: none at the threshold of the highest F1.")])
    about = "accepted at the threshold of the highest F1, smallest descriptor distance first"
    if not images:
        header = ("query", "answered with", "metres apart", "descriptor distance")
        rows = [(str(x.query), str(x.answer), f"{x.metres:.1f}", f"{x.distance:.4g}") for x in found.worst]
        table = report.TextTable(header, rows, header)
        return Section(title, [Text(f"{judged.name}: {about}."), table, missing("Their pictures: add --data.")])
    seen = {frame: bev_picture(image, f"frame {frame} from above") for frame, image in images.items()}
    pairs = [
        (
            seen[x.query],
            seen[x.answer],
            f"frame {x.query} answered with {x.answer}: {x.metres:.1f} m apart,\ndescriptor distance {x.distance:.4g}",
        )
        for x in found.worst
    ]
    return Section(title, [Text(f"{judged.name}: {about}."), PicturePairs(pairs)])
