"""Writes the folder of an evaluation: the results as JSON, the plots, and an HTML page with both."""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Num

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.views import view
from sglpr_jax.evaluation import figures, report
from sglpr_jax.evaluation.inputs import recording_rows
from sglpr_jax.evaluation.page import Picture, PicturePairs, Section, Text, bev_picture, figure_picture, missing, render
from sglpr_jax.evaluation.protocols import PROTOCOLS
from sglpr_jax.evaluation.protocols.protocol import Input
from sglpr_jax.evaluation.scoring import Evaluation, FalsePositive
from sglpr_jax.evaluation.segmentation import draw_map
from sglpr_jax.files import file_name, json_text, text_bytes, write_all
from sglpr_jax.metrics import PrecisionRecallCurve
from sglpr_jax.models.config import model_preset
from sglpr_jax.models.weights import Params
from sglpr_jax.retrieval.image_maps import heat_maps, semantic_map

if TYPE_CHECKING:
    import matplotlib.figure

NUMBERS = "results.json"
PAGE = "report.html"
CURVES = "precision-recall.png"
TRAJECTORY = "trajectory.png"
INTERVALS = (
    "95 %: bootstrap interval over the queries. Published on: poses of the published numbers of the protocol;"
    " scores on other poses differ."
)
NO_DECISIONS = (
    "Decisions along the recording: add --poses, and a protocol that answers queries (--protocol top1-f1max)."
)
SHOWN_SCANS = (1 / 3, 2 / 3)
"""Positions of the scans whose maps are shown, as fractions of the recording."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """Pictures of scans for the page. A text instead of pictures says which options of the command add them."""

    images: Mapping[int, Num[np.ndarray, "_ _"]] = field(default_factory=dict)
    """Point counts of the queries and answers of false positives, by frame number."""
    semantic: Sequence[Picture] | str = "Semantic maps: add --weights and --data."
    heat: Sequence[Picture] | str = "Feature heat maps: add --weights and --data."


def take_pictures(
    recording: Recording, params: Params | None, source: Input, worst: Sequence[FalsePositive]
) -> Pictures:
    """Return images of the false positives and, with `params`, maps of two scans of the recording."""
    row_of_frame = recording_rows(recording, source)  # raises ValueError if the frames differ
    grid = None if recording.has_images else model_preset("sglpr").grid  # ready-made images are not cropped
    frames = sorted({frame for false_positive in worst for frame in (false_positive.query, false_positive.answer)})
    images = {
        frame: np.asarray(view(recording.scan(row_of_frame[frame], labels=False), grid).image) for frame in frames
    }
    if params is None:
        advice = "maps: add --weights beside --data."
        return Pictures(images, f"Semantic {advice}", f"Feature heat {advice}")
    config = params.config
    semantic_pictures, heat_pictures = [], []
    rows = list(row_of_frame.values())  # without unreadable scans, which the descriptor file does not have
    for row in sorted({rows[int(fraction * len(rows))] for fraction in SHOWN_SCANS}):
        caption = f"frame {recording.ids[row]}"
        scan = recording.scan(row, labels=bool(config.categories_read))
        inputs = view(scan, config.grid, categories=config.categories_read, image=config.image)
        figure = figures.heat_maps(np.asarray(inputs.image), heat_maps(params, *inputs))
        heat_pictures.append(figure_picture(figure, f"feature heat maps of {caption}", caption=caption))
        if config.segments:
            figure = draw_map(semantic_map(params, recording.scan(row)), config, labelled=bool(recording.labelled[row]))
            semantic_pictures.append(figure_picture(figure, f"semantic map of {caption}", caption=caption))
    no_head = "Semantic maps: add --weights that have a segmentation head; these have none."
    return Pictures(images, semantic_pictures if config.segments else no_head, heat_pictures)


def write_evaluation(evaluation: Evaluation, folder: Path, pictures: Pictures | None = None) -> list[Path]:
    """Write results, plots and page to a folder. Return the paths."""
    plots = draw(evaluation)
    page = evaluation_page(evaluation, plots, pictures or Pictures())
    plot_names = {CURVES, TRAJECTORY, *(_curves_name(protocol.title) for protocol in PROTOCOLS.values())}
    # Plots of an earlier evaluation in this folder that the new one does not have are removed.
    stale_names = plot_names - set(plots) if (folder / PAGE).is_file() else set()
    results = text_bytes(json_text(evaluation.to_json()))
    writers = {NUMBERS: functools.partial(Path.write_bytes, data=results)}
    writers |= {name: functools.partial(figures.write, figure) for name, figure in plots.items()}
    writers |= {PAGE: functools.partial(Path.write_bytes, data=text_bytes(page))}
    paths = write_all(folder, writers)
    for name in stale_names:
        (folder / name).unlink(missing_ok=True)
    return paths


def draw(evaluation: Evaluation) -> "dict[str, matplotlib.figure.Figure]":
    """Return the figures by file name: precision-recall curves, and the decisions along the trajectory.

    One method gets a plot with a line for each protocol. Several methods get a plot for each protocol, with a line for
    each method. The decisions are those of the first method, by its first protocol that has decisions.
    """
    plots = {}
    if len(evaluation.methods) == 1:
        curves = {result.name: result.curve for result in evaluation.results}
        plots[CURVES] = _draw_curves(curves, title=evaluation.title)
    else:
        for results in zip(*evaluation.methods.values(), strict=True):
            curves = {method: result.curve for method, result in zip(evaluation.methods, results, strict=True)}
            plots[_curves_name(results[0].name)] = _draw_curves(curves, title=results[0].name)
    for result in evaluation.results:
        if result.decisions is not None and evaluation.positions is not None:
            plots[TRAJECTORY] = figures.trajectory(evaluation.positions, result.decisions, title=result.name)
            break
    return {name: figure for name, figure in plots.items() if figure is not None}


def _draw_curves(curves: Mapping[str, PrecisionRecallCurve | None], *, title: str) -> "matplotlib.figure.Figure | None":
    """Draw the curves that are not None, or return None without such curves."""
    drawable = {name: curve for name, curve in curves.items() if curve is not None}
    return figures.precision_recall(drawable, title=title) if drawable else None


def _curves_name(title: str) -> str:
    """Return the file name of the plot of several methods, given the title of the protocol."""
    return f"precision-recall-{file_name(title.lower().replace(' ', '-').replace(':', '-'))}.png"


def evaluation_page(evaluation: Evaluation, plots: "Mapping[str, matplotlib.figure.Figure]", pictures: Pictures) -> str:
    """Return the page as HTML, with the `plots` of `draw`. An empty section names the option that adds its content."""
    table = report.results_table(evaluation.results, published_on=True)
    results = Section("Results", [table, Text(INTERVALS, "about"), report.threshold_table(evaluation.results)])
    published = [Text(block, "about") if isinstance(block, str) else block for block in evaluation.published_tables()]
    if evaluation.database is not None:
        sections = [Section("Sessions", [evaluation.table(), *published]), results]
        return render(evaluation.title, evaluation.about, sections)
    sections = [results]
    if len(evaluation.methods) > 1:
        sections.append(Section("Methods side by side", [evaluation.table()]))
    if published:  # in a section of their own: the paper's numbers are of real KITTI and by several protocols
        sections.append(Section("Published numbers", published))
    curves = [figure_picture(plot, "precision over recall") for name, plot in plots.items() if name != TRAJECTORY]
    trajectory = []
    if TRAJECTORY in plots:
        trajectory = [figure_picture(plots[TRAJECTORY], "every frame, coloured by its decision")]
    activation = Text("Activation strength of each layer: root mean square over the channels.")
    sections += [
        _picture_section("Precision and recall", curves or "No protocol of this evaluation has a curve."),
        _picture_section("Trajectory", trajectory or NO_DECISIONS),
        _false_positive_section(evaluation, pictures.images),
        _picture_section("Semantic maps", pictures.semantic),
        _picture_section("Feature heat maps", pictures.heat, activation),
    ]
    return render(evaluation.title, evaluation.about, sections)


def _picture_section(title: str, pictures: Sequence[Picture] | str, *notes: Text) -> Section:
    """Return a section of pictures. A text instead of pictures says why they are missing."""
    return Section(title, [missing(pictures)] if isinstance(pictures, str) else [*notes, *pictures])


def _false_positive_section(evaluation: Evaluation, images: Mapping[int, np.ndarray]) -> Section:
    """Return the false positives with the smallest descriptor distances, as pairs of `images` or as a table."""
    title, result, worst = "Worst false positives", evaluation.thresholded_result, evaluation.worst_false_positives
    if result is None:
        advice = "Wrong answers: add a protocol that applies a threshold (--protocol top1-f1max)."
        return Section(title, [missing(advice)])
    if not worst:
        return Section(title, [Text(f"{result.name}: none at the threshold of the highest F1.")])
    about = Text(f"{result.name}: accepted at the threshold of the highest F1, smallest descriptor distance first.")
    if not images:
        header = ("query", "answered with", "metres apart", "descriptor distance")
        rows = [(str(x.query), str(x.answer), f"{x.metres:.1f}", f"{x.distance:.4g}") for x in worst]
        return Section(title, [about, report.TextTable(header, rows, header), missing("Their pictures: add --data.")])
    pictures = {frame: bev_picture(image, f"frame {frame} from above") for frame, image in images.items()}
    pairs = []
    for x in worst:
        frames = f"frame {x.query} answered with {x.answer}: {x.metres:.1f} m apart"
        caption = f"{frames},\ndescriptor distance {x.distance:.4g}"
        pairs.append((pictures[x.query], pictures[x.answer], caption))
    return Section(title, [about, PicturePairs(pairs)])
