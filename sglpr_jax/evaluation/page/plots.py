"""Plots of an evaluation, by file name."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.scoring import Evaluation
from sglpr_jax.files import file_name

if TYPE_CHECKING:
    import matplotlib.figure

Plots = dict[str, "matplotlib.figure.Figure"]
CURVES = "precision-recall.png"
TRAJECTORY = "trajectory.png"


def plot_names(results: Iterable[str]) -> set[str]:
    """Return all possible file names of the plots of results with these names."""
    return {CURVES, TRAJECTORY, *map(_name, results)}


def draw_curves(found: Evaluation) -> Plots:
    """Draw precision-recall curves.

    A single method gets one plot with a line for each protocol. Several methods get one plot for each protocol, with a
    line for each method.
    """
    if len(found.methods) == 1:
        curves = {result.name: result.curve for result in found.results if result.curve is not None}
        return {CURVES: figures.precision_recall(curves, title=found.title)} if curves else {}
    plots = {}
    for of_one in zip(*found.methods.values(), strict=True):
        pairs = zip(found.methods, of_one, strict=True)
        curves = {method: result.curve for method, result in pairs if result.curve is not None}
        if curves:
            plots[_name(of_one[0].name)] = figures.precision_recall(curves, title=of_one[0].name)
    return plots


def draw_trajectory(found: Evaluation) -> Plots:
    """Draw the trajectory with the decisions of the first protocol that has decisions."""
    for result in found.results:
        if found.positions is not None and result.decisions is not None:
            return {TRAJECTORY: figures.trajectory(found.positions, result.decisions, title=result.name)}
    return {}


def _name(result: str) -> str:
    """Return the file name of the plot of several methods by one protocol."""
    return f"precision-recall-{file_name(result.lower().replace(' ', '-').replace(':', '-'))}.png"
