"""Draws the learning curves of a training run when it ends."""

from pathlib import Path

from sglpr_jax.evaluation import figures
from sglpr_jax.training.callbacks import Callback
from sglpr_jax.training.loss_terms import TERM_NAMES
from sglpr_jax.training.metrics_log import read_metrics
from sglpr_jax.training.trainer import METRICS_FILE

PICTURE = "learning-curves.png"
PANELS = {
    "loss": ("loss", *TERM_NAMES),
    "score of held-out or training places": ("score",),
    "gradient norm": ("gradient_norm",),
}
"""Title of each panel, and the names of its curves in the metrics file."""


class LearningCurves(Callback):
    """Draws the learning curves of the run in `folder` when training ends."""

    def __init__(self, folder: Path):
        self._folder = folder

    def on_end(self, step: int) -> None:
        """Draw loss terms, score and gradient norm of the whole run, including those of earlier processes."""
        measurements = read_metrics(self._folder / METRICS_FILE)
        if not measurements:
            return
        panels = {title: {} for title in PANELS}
        for title, names in PANELS.items():
            for name in names:
                measured = [line for line in measurements if line.get(name) is not None]
                if measured:
                    panels[title][name] = [(line["step"], line[name]) for line in measured]
        figures.save(figures.learning_curves(panels), self._folder / PICTURE)
