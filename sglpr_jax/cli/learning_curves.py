"""learning-curves.png: a run's loss terms, its score and the norm of its gradient over the steps."""

import importlib.util
from pathlib import Path
from typing import Any

from sglpr_jax.evaluation import figures
from sglpr_jax.train.loop import METRICS_FILE
from sglpr_jax.train.metrics_log import read_metrics

PICTURE = "learning-curves.png"
_PANELS = {
    "loss": ("loss", "triplet", "cross_entropy", "dice"),
    "score: recall@1 of held-out or training places": ("score",),
    "gradient norm": ("gradient_norm",),
}
"""What each panel shows, and the names of its measurements in the metrics."""


def draw_learning_curves(folder: Path) -> None:
    """Draw the metrics in a run's folder; nothing without matplotlib, or where nothing was measured yet."""
    lines = read_metrics(folder / METRICS_FILE)
    if lines and importlib.util.find_spec("matplotlib"):
        panels = {title: _curves(lines, names) for title, names in _PANELS.items()}
        figures.save(figures.learning_curves(panels), folder / PICTURE)


def _curves(lines: list[dict[str, Any]], names: tuple[str, ...]) -> dict[str, list[tuple[int, float]]]:
    """The (step, value) of each measurement; one that was never made has no curve."""
    curves = {name: [(line["step"], line[name]) for line in lines if line.get(name) is not None] for name in names}
    return {name: points for name, points in curves.items() if points}
