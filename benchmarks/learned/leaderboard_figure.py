"""The figure of the leaderboard: Recall@1 along the trainings, and against the time of a descriptor."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from benchmarks.learned.cells import TOWN, finals, mean, method_of
from sglpr_jax.files import replacing
from sglpr_jax.methods.learned.weights_file import RANDOM

LABEL = {"rotation": -25, "ha": "left", "va": "top", "rotation_mode": "anchor"}
"""Labels run downwards, so that those of near points are apart."""


def draw(results: Mapping[str, Any], path: Path) -> None:
    """Write the figure as SVG. The same results give the same bytes."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    times = {method_of(name): cost["ms"] for name, cost in results["costs"].items()}
    left, right = figure.subplots(1, 2, sharey=True)
    for name, run in results["runs"].items():
        curve = run["curve"]
        left.plot([one["images"] for one in curve], [one["recall_at_1"] for one in curve], "o-", label=name)
    left.set(xscale="log", ylim=(0, 1.04), xlabel="images seen", ylabel="Recall@1", title="held-out town")
    left.legend(fontsize="x-small")
    for name in (one for one in finals(results["scores"]) if RANDOM not in one):
        recall = mean(results["scores"][name], TOWN, "recall")
        if method_of(name) in times and recall is not None:
            right.plot(times[method_of(name)], recall, "o")
            right.annotate(name, (times[method_of(name)], recall), fontsize="x-small", **LABEL)
    right.set(xscale="log", xlabel="milliseconds per descriptor", title="unseen town")
    with matplotlib.rc_context({"svg.hashsalt": "leaderboard", "svg.fonttype": "none"}), replacing(path) as temporary:
        figure.savefig(temporary, format="svg", metadata={"Date": None})
