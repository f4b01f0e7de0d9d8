"""learning-curves.png: a run's loss terms, its score and the norm of its gradient over the steps."""

from pathlib import Path
from typing import Any

from sglpr_jax.evaluation import figures
from sglpr_jax.training.callbacks import Callback
from sglpr_jax.training.loop import METRICS_FILE
from sglpr_jax.training.loss import TERM_NAMES
from sglpr_jax.training.metrics_log import read_metrics

PICTURE = "learning-curves.png"
_PANELS = {
    "loss": ("loss", *TERM_NAMES),
    "score: recall@1 of held-out or training places": ("score",),
    "gradient norm": ("gradient_norm",),
}
"""What each panel shows, and the names of its measurements in the metrics."""


class LearningCurves(Callback):
    """Draws the learning curves of the run in `folder` at its end; nothing without matplotlib (extra `viz`)."""

    def __init__(self, folder: Path):
        self._folder = folder

    def on_end(self, step: int) -> None:
        """Draw all that was measured, by this process or by earlier ones of the same run."""
        draw_learning_curves(self._folder)


def draw_learning_curves(folder: Path) -> None:
    """Draw the metrics in a run's folder; nothing without matplotlib, or where nothing was measured yet."""
    lines = read_metrics(folder / METRICS_FILE)
    if lines and figures.can_draw():
        panels = {title: _curves(lines, names) for title, names in _PANELS.items()}
        figures.save(figures.learning_curves(panels), folder / PICTURE)


def _curves(lines: list[dict[str, Any]], names: tuple[str, ...]) -> dict[str, list[tuple[int, float]]]:
    """The (step, value) of each measurement; one that was never made has no curve."""
    curves = {name: [(line["step"], line[name]) for line in lines if line.get(name) is not None] for name in names}
    return {name: points for name, points in curves.items() if points}
