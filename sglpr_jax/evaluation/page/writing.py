"""Writes the numbers, plots and page of an evaluation to a folder."""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.page import Pictures, draw_curves, draw_trajectory, page
from sglpr_jax.evaluation.page.across_sessions import sessions_page
from sglpr_jax.evaluation.page.plots import Plots, plot_names
from sglpr_jax.evaluation.scoring import Evaluation
from sglpr_jax.evaluation.sessions import AcrossSessions
from sglpr_jax.files import json_text, read_json, text_bytes, write_all

NUMBERS = "results.json"
PAGE = "report.html"


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
    html = page(found, curves=curves, trajectory=trajectory, pictures=pictures or Pictures())
    return _write(folder, found.to_json(), curves | trajectory, html)


def write_sessions(found: AcrossSessions, folder: Path) -> list[Path]:
    """Write numbers and page of an evaluation across sessions. Otherwise as `write_evaluation`."""
    return _write(folder, found.to_json(), {}, sessions_page(found))


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
        return plot_names([result["protocol"] for result in read_json(folder / NUMBERS)["results"]])
    except (OSError, ValueError, LookupError, TypeError, AttributeError):  # missing, damaged, or from another command
        return set()
