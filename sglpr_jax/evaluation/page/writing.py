"""An evaluation on disk: its numbers, its plots and its page in one folder."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.page import Pictures, draw_curves, draw_trajectory, page
from sglpr_jax.evaluation.page.across_sessions import sessions_page
from sglpr_jax.evaluation.page.plots import Plots, plot_names
from sglpr_jax.evaluation.scoring import Evaluation
from sglpr_jax.evaluation.sessions import AcrossSessions
from sglpr_jax.files import read_json, write_json, write_text

NUMBERS = "results.json"
PAGE = "report.html"


def write_evaluation(found: Evaluation, folder: Path, pictures: Pictures | None = None) -> list[Path]:
    """Write numbers, plots and the page; without matplotlib no plots. Returns the paths written.

    `pictures` are what a dataset and a model have to show, by frame. Plots that an earlier evaluation has left in the
    folder are removed.
    """
    curves, trajectory = (draw_curves(found), draw_trajectory(found)) if figures.can_draw() else ({}, {})
    html = page(found, curves=curves, trajectory=trajectory, pictures=pictures or Pictures())
    return _write(folder, found.to_json(), curves | trajectory, html)


def write_sessions(found: AcrossSessions, folder: Path) -> list[Path]:
    """Write numbers and the page of an evaluation across sessions; else as `write_evaluation`."""
    return _write(folder, found.to_json(), {}, sessions_page(found))


def _write(folder: Path, numbers: Mapping[str, Any], plots: Plots, html: str) -> list[Path]:
    """Write all of an evaluation in place of an earlier one. Returns the paths written."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in _earlier_plots(folder) - set(plots):
        (folder / name).unlink(missing_ok=True)
    write_json(folder / NUMBERS, numbers)
    for name, figure in plots.items():
        figures.save(figure, folder / name)
    write_text(folder / PAGE, html)
    return [folder / name for name in (NUMBERS, *plots, PAGE)]


def _earlier_plots(folder: Path) -> set[str]:
    """Return the names that the plots of the evaluation in a folder may have; none where its numbers are of no such."""
    try:
        return plot_names([result["protocol"] for result in read_json(folder / NUMBERS)["results"]])
    except (OSError, ValueError, LookupError, TypeError, AttributeError):  # none there, damaged, or of another command
        return set()
