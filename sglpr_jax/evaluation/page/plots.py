"""The plots of an evaluation, by the name of the file that each is written to."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

from sglpr_jax.evaluation import figures
from sglpr_jax.evaluation.scoring import Evaluation

if TYPE_CHECKING:
    import matplotlib.figure

Plots = dict[str, "matplotlib.figure.Figure"]
CURVES = "precision-recall.png"
TRAJECTORY = "trajectory.png"


def plot_names(results: Iterable[str]) -> set[str]:
    """Return every name that a plot of results with these names may have."""
    return {CURVES, TRAJECTORY, *map(_name, results)}


def draw_curves(found: Evaluation) -> Plots:
    """Draw the curves of one method in one plot; of several methods one plot for each protocol, a line for each."""
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
    """Draw the decisions of the first protocol that has any."""
    for result in found.results:
        if found.positions is not None and result.decisions is not None:
            return {TRAJECTORY: figures.trajectory(found.positions, result.decisions, title=result.name)}
    return {}


def _name(result: str) -> str:
    """The file of the curves of several methods by one protocol."""
    return f"precision-recall-{result.lower().replace(' ', '-').replace(':', '-')}.png"
