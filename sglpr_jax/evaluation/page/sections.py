"""Sections of the HTML page of an evaluation."""

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.false_positives import FalsePositive
from sglpr_jax.evaluation.page.document import Section, bev_html, figure_html, html_table, missing
from sglpr_jax.evaluation.page.pictures import HeatPicture, SemanticPicture
from sglpr_jax.evaluation.page.plots import Plots
from sglpr_jax.evaluation.protocols.protocol import Result
from sglpr_jax.evaluation.report import (
    COLUMNS,
    PUBLISHED_COLUMNS,
    PUBLISHED_NOTE,
    THRESHOLD_COLUMNS,
    cells,
    format_score,
    threshold_rows,
)

NO_MATPLOTLIB = "Drawings: install the extra viz (pip install 'sglpr-jax[viz]')."
INTERVALS = (
    "95 %: bootstrap interval over the queries. Published on: poses of the published numbers of the protocol;"
    " scores on other poses differ."
)


def results_section(results: Sequence[Result]) -> Section:
    """Tables of one method: rule, score, interval, counts and poses of every protocol, and thresholds."""
    rows = [(*cells(result), result.published_on) for result in results]
    table = html_table((*COLUMNS, "published on"), rows, numbers=("score", "95 %", "rests on"))
    thresholds = html_table(THRESHOLD_COLUMNS, threshold_rows(results), numbers=THRESHOLD_COLUMNS[2:])
    return Section("Results", f"{table}\n<p class='about'>{INTERVALS}</p>\n{thresholds}")


def comparison_section(methods: Mapping[str, Sequence[Result]]) -> Section:
    """Table of scores with one row per protocol and one column per method."""
    of_each = zip(*methods.values(), strict=True)
    rows = [(results[0].name, *map(format_score, results)) for results in of_each]
    return Section("Methods side by side", html_table(("protocol", *methods), rows, numbers=list(methods)))


def published_section(rows: Sequence[tuple[str, ...]]) -> Section:
    """Table of the numbers of table 1 for the sequence.

    It is separate from our results, because the numbers come from real KITTI and from several protocols.
    """
    table = html_table(PUBLISHED_COLUMNS, rows, numbers=PUBLISHED_COLUMNS[1:2])
    return Section("Published numbers", f"{table}\n<p class='about'>{escape(PUBLISHED_NOTE)}</p>")


def curves_section(plots: Plots, *, drawn: bool) -> Section:
    """Precision-recall curves (figure 5)."""
    nothing = missing("No protocol of this evaluation has a curve." if drawn else NO_MATPLOTLIB)
    body = "\n".join(figure_html(plot, "precision over recall") for plot in plots.values())
    return Section("Precision and recall", body or nothing)


def trajectory_section(plots: Plots, *, drawn: bool) -> Section:
    """Trajectory coloured by decision (figure 6): red is found, black is missed, blue has no revisit."""
    needs = "Decisions along the recording: add --poses, and a protocol that answers queries (--protocol top1-f1max)."
    nothing = missing(needs if drawn else NO_MATPLOTLIB)
    body = "\n".join(figure_html(plot, "every frame, coloured by its decision") for plot in plots.values())
    return Section("Trajectory", body or nothing)


def false_positives_section(
    judged: Result | None, worst: Sequence[FalsePositive], images: Mapping[int, np.ndarray]
) -> Section:
    """Wrong answers with the smallest descriptor distance, as pairs of images if these are given."""
    title = "Worst false positives"
    if judged is None:
        return Section(
            title, missing("Wrong answers: add a protocol that applies a threshold (--protocol top1-f1max).")
        )
    if not worst:
        return Section(title, f"<p>{escape(judged.name)}: none at the threshold of the highest F1.</p>")
    order = "accepted at the threshold of the highest F1, smallest descriptor distance first"
    about = f"<p>{escape(judged.name)}: {order}.</p>"
    if not images:
        header = ("query", "answered with", "metres apart", "descriptor distance")
        rows = [(str(x.query), str(x.answer), f"{x.metres:.1f}", f"{x.distance:.4g}") for x in worst]
        return Section(title, about + html_table(header, rows, numbers=header) + missing("Their pictures: add --data."))
    pairs = "\n".join(_pair(x, images) for x in worst)
    return Section(title, f'{about}\n<div class="pairs">\n{pairs}\n</div>')


def _pair(found: FalsePositive, images: Mapping[int, np.ndarray]) -> str:
    left, right = (bev_html(images[i], f"frame {i} from above") for i in (found.query, found.answer))
    said = f"frame {found.query} answered with {found.answer}: {found.metres:.1f} m apart"
    caption = f"<figcaption>{said},<br>descriptor distance {found.distance:.4g}</figcaption>"
    return f'<figure><div class="two">{left}{right}</div>{caption}</figure>'


def semantic_section(found: Mapping[str, SemanticPicture] | str) -> Section:
    """Semantic maps (figure 7)."""
    if isinstance(found, str):
        return Section("Semantic maps", missing(found))
    return Section("Semantic maps", "\n".join(_semantic(frame, one) for frame, one in found.items()))


def _semantic(frame: str, one: SemanticPicture) -> str:
    panel = figures.segmentation_panel(
        one.counts, one.truth, one.predicted, resolution_m=one.resolution_m, categories=one.categories
    )
    return figure_html(panel, f"semantic map of frame {frame}", caption=f"frame {frame}")


def heat_section(found: Mapping[str, HeatPicture] | str) -> Section:
    """Feature heat maps (figure 8)."""
    if isinstance(found, str):
        return Section("Feature heat maps", missing(found))
    about = "<p>Activation strength of each layer: root mean square over the channels.</p>\n"
    return Section("Feature heat maps", about + "\n".join(_heat(frame, one) for frame, one in found.items()))


def _heat(frame: str, one: HeatPicture) -> str:
    panel = figures.heat_maps(one.image, one.maps)
    return figure_html(panel, f"feature heat maps of frame {frame}", caption=f"frame {frame}")
