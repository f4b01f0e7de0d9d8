"""An evaluation on disk: its numbers, its plots and its page in one folder."""

from pathlib import Path

from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.page import Pictures, draw_curves, draw_trajectory, page
from sglpr_jax.evaluation.page.across_sessions import sessions_page
from sglpr_jax.evaluation.scoring import Evaluation
from sglpr_jax.evaluation.sessions import AcrossSessions
from sglpr_jax.files import write_json, write_text

NUMBERS = "results.json"
PAGE = "report.html"


def write_evaluation(found: Evaluation, folder: Path, pictures: Pictures | None = None) -> list[Path]:
    """Write numbers, plots and the page; without matplotlib no plots. Returns the paths written.

    `pictures` are what a dataset and a model have to show, by frame.
    """
    curves, trajectory = (draw_curves(found), draw_trajectory(found)) if figures.can_draw() else ({}, {})
    html = page(found, curves=curves, trajectory=trajectory, pictures=pictures or Pictures())
    plots = curves | trajectory
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / NUMBERS, found.to_json())
    for name, figure in plots.items():
        figures.save(figure, folder / name)
    write_text(folder / PAGE, html)
    return [folder / name for name in (NUMBERS, *plots, PAGE)]


def write_sessions(found: AcrossSessions, folder: Path) -> list[Path]:
    """Write numbers and the page of an evaluation across sessions. Returns the paths written."""
    html = sessions_page(found)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / NUMBERS, found.to_json())
    write_text(folder / PAGE, html)
    return [folder / name for name in (NUMBERS, PAGE)]
