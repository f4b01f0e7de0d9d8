"""Plot of the loss terms, the score and the gradient norm of a training run (learning-curves.png)."""

from pathlib import Path
from typing import Any

from sglpr_jax.evaluation import figures
from sglpr_jax.training.callbacks import Callback
from sglpr_jax.training.loss import TERM_NAMES
from sglpr_jax.training.metrics_log import read_metrics
from sglpr_jax.training.trainer import METRICS_FILE

PICTURE = "learning-curves.png"
_PANELS = {
    "loss": ("loss", *TERM_NAMES),
    "score: recall@1 of held-out or training places": ("score",),
    "gradient norm": ("gradient_norm",),
}
"""Title of each panel, and the names of its curves in the metrics file."""


class LearningCurves(Callback):
    """Draws the learning curves of the run in `folder` when training ends, if matplotlib (extra `viz`) is installed."""

    def __init__(self, folder: Path):
        self._folder = folder

    def on_end(self, step: int) -> None:
        """Draw the metrics of the whole run, including those of earlier processes."""
        draw_learning_curves(self._folder)


def draw_learning_curves(folder: Path) -> None:
    """Plot the metrics of a run and save the figure in the run's folder.

    Does nothing without matplotlib or without metrics.
    """
    lines = read_metrics(folder / METRICS_FILE)
    if lines and figures.can_draw():
        panels = {title: _curves(lines, names) for title, names in _PANELS.items()}
        figures.save(figures.learning_curves(panels), folder / PICTURE)


def _curves(lines: list[dict[str, Any]], names: tuple[str, ...]) -> dict[str, list[tuple[int, float]]]:
    """Return (step, value) points by name. A name without values has no curve."""
    curves = {name: [(line["step"], line[name]) for line in lines if line.get(name) is not None] for name in names}
    return {name: points for name, points in curves.items() if points}
