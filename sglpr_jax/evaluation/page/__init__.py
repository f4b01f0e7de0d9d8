"""Self-contained HTML page of an evaluation."""

from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.page import sections
from sglpr_jax.evaluation.page.document import document
from sglpr_jax.evaluation.page.pictures import HeatPicture, Pictures, SemanticPicture
from sglpr_jax.evaluation.page.plots import Plots, draw_curves, draw_trajectory
from sglpr_jax.evaluation.scoring import Evaluation


def page(found: Evaluation, *, curves: Plots, trajectory: Plots, pictures: Pictures) -> str:
    """Return the page as HTML.

    If a section cannot be filled, one line names the command-line option that adds it.
    """
    drawn = figures.can_draw()
    parts = [sections.results_section(found.results)]
    if len(found.methods) > 1:
        parts.append(sections.comparison_section(found.methods))
    if found.published:
        parts.append(sections.published_section(found.published))
    parts += [
        sections.curves_section(curves, drawn=drawn),
        sections.trajectory_section(trajectory, drawn=drawn),
        sections.false_positives_section(found.judged, found.worst, pictures.images),
        sections.semantic_section(pictures.semantic if drawn else sections.NO_MATPLOTLIB),
        sections.heat_section(pictures.heat if drawn else sections.NO_MATPLOTLIB),
    ]
    return document(found.title, found.about, parts)


__all__ = [
    "HeatPicture",
    "Pictures",
    "Plots",
    "SemanticPicture",
    "draw_curves",
    "draw_trajectory",
    "page",
]
