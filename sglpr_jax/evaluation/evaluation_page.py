"""Folder of an evaluation: its numbers as JSON, its plots, and a page with all of them."""

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
from sglpr_jax.models.config import model_preset
from sglpr_jax.models.params import Params
from sglpr_jax.retrieval.image_maps import heat_maps, semantic_map

if TYPE_CHECKING:
    import matplotlib.figure

NUMBERS = "results.json"
PAGE = "report.html"
CURVES = "precision-recall.png"
TRAJECTORY = "trajectory.png"
NO_MATPLOTLIB = "Drawings: install the extra viz (pip install 'sglpr-jax[viz]')."
INTERVALS = (
    "95 %: bootstrap interval over the queries. Published on: poses of the published numbers of the protocol;"
    " scores on other poses differ."
)
NO_DECISIONS = (
    "Decisions along the recording: add --poses, and a protocol that answers queries (--protocol top1-f1max)."
)
SHOWN = (1 / 3, 2 / 3)
"""Positions of the scans whose maps are shown, as fractions of the recording."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """Pictures of scans for the page. A string instead of pictures says which options add them."""

    images: Mapping[int, Num[np.ndarray, "_ _"]] = field(default_factory=dict)
    """Point counts of the queries and answers of false positives, by frame number."""
    semantic: Sequence[Picture] | str = "Semantic maps: add --weights and --data."
    heat: Sequence[Picture] | str = "Feature heat maps: add --weights and --data."


def take_pictures(
    recording: Recording, params: Params | None, source: Input, worst: Sequence[FalsePositive]
) -> Pictures:
    """Return images of the false positives and, with `params`, maps of two scans of the recording.

    Raises ValueError if `source` and the recording have different frames.
    """
    rows = recording_rows(recording, source)
    grid = None if recording.has_images else model_preset("sglpr").grid  # ready-made images are not cropped
    frames = sorted({frame for mistake in worst for frame in (mistake.query, mistake.answer)})
    images = {frame: np.asarray(view(recording.scan(rows[frame], labels=False), grid).image) for frame in frames}
    if params is None:
        needs = "maps: add --weights beside --data."
        return Pictures(images, f"Semantic {needs}", f"Feature heat {needs}")
    if not figures.can_draw():
        return Pictures(images)
    config, semantic, heat = params.config, [], []
    for row in sorted({int(part * len(recording)) for part in SHOWN}):
        scan, caption = recording.scan(row, labels=bool(config.categories_read)), f"frame {recording.ids[row]}"
        inputs = view(scan, config.grid, categories=config.categories_read, image=config.image)
        figure = figures.heat_maps(np.asarray(inputs.image), heat_maps(params, *inputs))
        heat.append(figure_picture(figure, f"feature heat maps of {caption}", caption=caption))
        if config.segments:
            figure = draw_map(semantic_map(params, recording.scan(row)), config, labelled=bool(recording.labelled[row]))
            semantic.append(figure_picture(figure, f"semantic map of {caption}", caption=caption))
    without_head = "Semantic maps: add --weights that have a segmentation head; these have none."
    return Pictures(images, semantic if config.segments else without_head, heat)


def write_evaluation(evaluation: Evaluation, folder: Path, pictures: Pictures | None = None) -> list[Path]:
    """Write numbers, plots (with matplotlib) and page to a folder, and remove the plots of an earlier evaluation there.

    Returns the paths written.
    """
    plots = draw(evaluation) if figures.can_draw() else {}
    page = evaluation_page(evaluation, plots, pictures or Pictures())
    numbers = json_text(evaluation.to_json())
    earlier = {CURVES, TRAJECTORY, *(_curves_name(protocol.title) for protocol in PROTOCOLS.values())}
    stale = earlier - set(plots) if (folder / PAGE).is_file() else set()
    drawings = {name: functools.partial(figures.write, figure) for name, figure in plots.items()}
    write_numbers, write_page = (functools.partial(Path.write_bytes, data=text_bytes(text)) for text in (numbers, page))
    written = write_all(folder, {NUMBERS: write_numbers, **drawings, PAGE: write_page})
    for name in stale:
        (folder / name).unlink(missing_ok=True)
    return written


def draw(evaluation: Evaluation) -> "dict[str, matplotlib.figure.Figure]":
    """Draw precision-recall curves, and the trajectory with the decisions of the first protocol that has decisions.

    One method gets a plot of curves with a line for each protocol, several methods a plot for each protocol. Returns
    the figures by file name.
    """
    curves = {CURVES: (evaluation.title, {result.name: result.curve for result in evaluation.results})}
    if len(evaluation.methods) > 1:
        curves = {
            _curves_name(results[0].name): (
                results[0].name,
                {method: result.curve for method, result in zip(evaluation.methods, results, strict=True)},
            )
            for results in zip(*evaluation.methods.values(), strict=True)
        }
    plots = {}
    for name, (title, by_label) in curves.items():
        lines = {label: curve for label, curve in by_label.items() if curve is not None}
        if lines:
            plots[name] = figures.precision_recall(lines, title=title)
    with_decisions = (result for result in evaluation.results if result.decisions is not None)
    result = next(with_decisions, None)
    if evaluation.positions is not None and result is not None and result.decisions is not None:
        plots[TRAJECTORY] = figures.trajectory(evaluation.positions, result.decisions, title=result.name)
    return plots


def _curves_name(result: str) -> str:
    """Return the file name of the plot of several methods by one protocol."""
    return f"precision-recall-{file_name(result.lower().replace(' ', '-').replace(':', '-'))}.png"


def evaluation_page(evaluation: Evaluation, plots: "Mapping[str, matplotlib.figure.Figure]", pictures: Pictures) -> str:
    """Return the page as HTML. If a section cannot be filled, one line names the option that adds it."""
    table = report.results_table(evaluation.results, published_on=True)
    results = Section("Results", [table, Text(INTERVALS, "about"), report.threshold_table(evaluation.results)])
    published = [Text(block, "about") if isinstance(block, str) else block for block in evaluation.published_tables()]
    if evaluation.database is not None:
        sections = [Section("Sessions", [evaluation.table(), *published]), results]
        return render(evaluation.title, evaluation.about, sections)
    sections = [results]
    if len(evaluation.methods) > 1:
        sections.append(Section("Methods side by side", [evaluation.table()]))
    if published:  # apart from our results: these are of real KITTI and by several protocols
        sections.append(Section("Published numbers", published))
    curves = [figure_picture(plot, "precision over recall") for name, plot in plots.items() if name != TRAJECTORY]
    decisions = "every frame, coloured by its decision"
    trajectory = [figure_picture(plots[TRAJECTORY], decisions)] if TRAJECTORY in plots else []
    activation = Text("Activation strength of each layer: root mean square over the channels.")
    sections += [
        _drawings("Precision and recall", curves or "No protocol of this evaluation has a curve."),
        _drawings("Trajectory", trajectory or NO_DECISIONS),
        _false_positives(evaluation, pictures.images),
        _drawings("Semantic maps", pictures.semantic),
        _drawings("Feature heat maps", pictures.heat, activation),
    ]
    return render(evaluation.title, evaluation.about, sections)


def _drawings(title: str, pictures: Sequence[Picture] | str, *notes: Text) -> Section:
    """Section of pictures, or of the reason for their absence."""
    pictures = pictures if figures.can_draw() else NO_MATPLOTLIB
    return Section(title, [missing(pictures)] if isinstance(pictures, str) else [*notes, *pictures])


def _false_positives(evaluation: Evaluation, images: Mapping[int, np.ndarray]) -> Section:
    """Wrong answers with the smallest descriptor distance, as pairs of images if these are known."""
    title, judged, worst = "Worst false positives", evaluation.judged, evaluation.worst
    if judged is None:
        needs = "Wrong answers: add a protocol that applies a threshold (--protocol top1-f1max)."
        return Section(title, [missing(needs)])
    if not worst:
        return Section(title, [Text(f"{judged.name}: none at the threshold of the highest F1.")])
    about = f"{judged.name}: accepted at the threshold of the highest F1, smallest descriptor distance first."
    if not images:
        header = ("query", "answered with", "metres apart", "descriptor distance")
        rows = [(str(x.query), str(x.answer), f"{x.metres:.1f}", f"{x.distance:.4g}") for x in worst]
        table = report.TextTable(header, rows, header)
        return Section(title, [Text(about), table, missing("Their pictures: add --data.")])
    by_frame = {frame: bev_picture(image, f"frame {frame} from above") for frame, image in images.items()}
    captions = [
        f"frame {x.query} answered with {x.answer}: {x.metres:.1f} m apart,\ndescriptor distance {x.distance:.4g}"
        for x in worst
    ]
    pairs = [(by_frame[x.query], by_frame[x.answer], caption) for x, caption in zip(worst, captions, strict=True)]
    return Section(title, [Text(about), PicturePairs(pairs)])
