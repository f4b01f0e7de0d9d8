"""Folder of an evaluation: its numbers as JSON, its plots, and a page with all of them."""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Num

from sglpr_jax.data.formats.pose_files import Trajectory
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.views import view
from sglpr_jax.evaluation import figures, report
from sglpr_jax.evaluation.inputs import Input
from sglpr_jax.evaluation.page import (
    PicturePairs,
    Section,
    Text,
    bev_picture,
    figure_picture,
    missing,
    render,
)
from sglpr_jax.evaluation.scoring import Evaluation, FalsePositive
from sglpr_jax.files import file_name, json_text, read_json, text_bytes, write_all
from sglpr_jax.models.config import model_preset
from sglpr_jax.models.params import Params
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.image_maps import heat_maps, semantic_map

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
SHOWN = (1 / 3, 2 / 3)
"""Positions of the scans whose maps are shown, as fractions of the recording."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """Pictures of a page, by frame. A string instead of figures says what adds them."""

    images: Mapping[int, Num[np.ndarray, "_ _"]] = field(default_factory=dict)
    """Point counts of the queries and answers of false positives, by frame number."""
    semantic: "Mapping[str, matplotlib.figure.Figure] | str" = "Semantic maps: add --weights and --data."
    heat: "Mapping[str, matplotlib.figure.Figure] | str" = "Feature heat maps: add --weights and --data."


def take_pictures(
    recording: Recording, params: Params | None, source: Input, worst: Sequence[FalsePositive]
) -> Pictures:
    """Return images of the false positives and, with `params`, maps of two scans of the recording.

    Raises ValueError if `source` and the recording have different frames.
    """
    rows = recording_rows(recording, source)
    grid = None if recording.has_images else model_preset("sglpr").grid  # ready-made images are not cropped
    images = {
        frame: np.asarray(view(recording.scan(rows[frame], labels=False), grid).image)
        for frame in sorted({frame for found in worst for frame in (found.query, found.answer)})
    }
    if params is None:
        needs = "maps: add --weights beside --data."
        return Pictures(images, f"Semantic {needs}", f"Feature heat {needs}")
    if not figures.can_draw():
        return Pictures(images)
    shown = sorted({int(part * len(recording)) for part in SHOWN})
    config, heat = params.config, {}
    for row in shown:
        scan = recording.scan(row, labels=bool(config.categories_read))
        seen = view(scan, config.grid, categories=config.categories_read, image=config.image)
        heat[recording.ids[row]] = figures.heat_maps(np.asarray(seen.image), heat_maps(params, *seen))
    if not params.config.segments:
        return Pictures(images, "Semantic maps: add --weights that have a segmentation head; these have none.", heat)
    return Pictures(images, {recording.ids[row]: semantic_figure(recording, params, row) for row in shown}, heat)


def poses_of(recording: Recording) -> Trajectory | None:
    """Return the positions and times of a recording, or None if it has no positions."""
    if recording.positions is None:
        return None
    return Trajectory(recording.positions, recording.times, recording.pose_source or recording.name)


def recording_rows(recording: Recording, source: Input) -> Mapping[int, int]:
    """Return the row in the recording of each frame of `source`.

    Frames are matched by id or, if ids do not match, by number. Raises ValueError if the numbers of frames differ, too.
    """
    n = len(recording) if source.positions is None else len(source.positions)
    row_of = {name: row for row, name in enumerate(recording.ids)}
    if isinstance(source, DescriptorFile) and set(source.ids) <= set(row_of):
        return {frame: row_of[name] for frame, name in enumerate(source.ids)}
    if n != len(recording):
        raise ValueError(
            f"--data: expected {n} frames in sequence {recording.name}, as in the input, found {len(recording)}"
        )
    return {frame: frame for frame in range(n)}


def semantic_figure(recording: Recording, params: Params, row: int, *, title: str = "") -> "matplotlib.figure.Figure":
    """Draw point counts and predicted semantic map of a scan, and the true map if the scan has labels (figure 7)."""
    config, found = params.config, semantic_map(params, recording.scan(row))
    return figures.segmentation_panel(
        found.counts,
        found.truth if recording.labelled[row] else None,
        found.predicted,
        resolution_m=config.grid.resolution_m,
        categories=config.categories,
        title=title,
    )


def write_evaluation(found: Evaluation, folder: Path, pictures: Pictures | None = None) -> list[Path]:
    """Write numbers, plots (with matplotlib) and page to a folder, and remove the plots of an earlier evaluation there.

    Returns the paths written.
    """
    plots = draw(found) if figures.can_draw() else {}
    html = evaluation_page(found, plots, pictures or Pictures())
    try:
        results = [result["protocol"] for result in read_json(folder / NUMBERS)["results"]]
        earlier = {CURVES, TRAJECTORY, *map(_curves_name, results)}
    except (OSError, ValueError, LookupError, TypeError, AttributeError):  # missing, damaged, or from another command
        earlier = set()
    drawn = {name: functools.partial(figures.write, figure) for name, figure in plots.items()}
    texts = {NUMBERS: json_text(found.to_json()), PAGE: html}
    said = {name: functools.partial(Path.write_bytes, data=text_bytes(text)) for name, text in texts.items()}
    written = write_all(folder, {NUMBERS: said[NUMBERS], **drawn, PAGE: said[PAGE]})
    for name in earlier - set(plots):
        (folder / name).unlink(missing_ok=True)
    return written


def draw(found: Evaluation) -> Plots:
    """Draw precision-recall curves, and the trajectory with the decisions of the first protocol that has decisions.

    One method gets a plot of curves with a line for each protocol, several methods a plot for each protocol.
    """
    lines = {CURVES: (found.title, {result.name: result.curve for result in found.results})}
    if len(found.methods) > 1:
        each = zip(*found.methods.values(), strict=True)
        by_method = (zip(found.methods, of_one, strict=True) for of_one in each)
        lines = {}
        for pairs in map(dict, by_method):
            title = next(iter(pairs.values())).name
            lines[_curves_name(title)] = title, {method: result.curve for method, result in pairs.items()}
    plots = {}
    for name, (title, curves) in lines.items():
        drawn = {label: curve for label, curve in curves.items() if curve is not None}
        if drawn:
            plots[name] = figures.precision_recall(drawn, title=title)
    decided = next((result for result in found.results if result.decisions is not None), None)
    if found.positions is not None and decided is not None and decided.decisions is not None:
        plots[TRAJECTORY] = figures.trajectory(found.positions, decided.decisions, title=decided.name)
    return plots


def _curves_name(result: str) -> str:
    """Return the file name of the plot of several methods by one protocol."""
    return f"precision-recall-{file_name(result.lower().replace(' ', '-').replace(':', '-'))}.png"


def evaluation_page(found: Evaluation, plots: Plots, pictures: Pictures) -> str:
    """Return the page as HTML. If a section cannot be filled, one line names the option that adds it."""
    table = report.results_table(found.results, published_on=True)
    sections = [Section("Results", [table, Text(INTERVALS, "about"), report.threshold_table(found.results)])]
    if found.database is not None:
        note = [Text(report.SESSIONS_NOTE, "about")] if found.published else []
        return render(found.title, found.about, [Section("Sessions", [found.table(), *note]), *sections])
    if len(found.methods) > 1:
        sections.append(Section("Methods side by side", [found.table()]))
    if found.published:  # apart from our results: these are of real KITTI and by several protocols
        table = report.published_table(found.published)
        sections.append(Section("Published numbers", [table, Text(report.PUBLISHED_NOTE, "about")]))
    trajectory = {TRAJECTORY: plots[TRAJECTORY]} if TRAJECTORY in plots else {}
    curves = {name: figure for name, figure in plots.items() if name not in trajectory}
    no_curve = "No protocol of this evaluation has a curve."
    no_decisions = (
        "Decisions along the recording: add --poses, and a protocol that answers queries (--protocol top1-f1max)."
    )
    activation = Text("Activation strength of each layer: root mean square over the channels.")
    sections += [
        _drawn("Precision and recall", curves or no_curve, lambda _: ("precision over recall", "")),
        _drawn("Trajectory", trajectory or no_decisions, lambda _: ("every frame, coloured by its decision", "")),
        _false_positives(found, pictures.images),
        _drawn("Semantic maps", pictures.semantic, lambda frame: (f"semantic map of {frame}", frame)),
        _drawn("Feature heat maps", pictures.heat, lambda frame: (f"feature heat maps of {frame}", frame), activation),
    ]
    return render(found.title, found.about, sections)


def _drawn(
    title: str,
    found: "Mapping[str, matplotlib.figure.Figure] | str",
    words: Callable[[str], tuple[str, str]],
    *before: Text,
) -> Section:
    """Section of figures, or of the reason for their absence. `words` returns the name and caption of a figure."""
    found = found if figures.can_draw() else NO_MATPLOTLIB
    if isinstance(found, str):
        return Section(title, [missing(found)])
    drawn = [(words(f"frame {key}"), figure) for key, figure in found.items()]
    return Section(title, [*before, *(figure_picture(one, name, caption=said) for (name, said), one in drawn)])


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
