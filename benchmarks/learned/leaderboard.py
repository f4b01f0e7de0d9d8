"""The page that compares all contenders, with its figure."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jinja2 import Template
from matplotlib.figure import Figure

from benchmarks.learned import tables
from sglpr_jax.files import replacing, write_json, write_text
from sglpr_jax.training.trainer import SCORES_FILE

KEPT = Path(__file__).with_name("results.json")
TEMPLATE = Path(__file__).with_name("leaderboard.md.jinja")
PAGE, FIGURE = Path("docs/leaderboard.md"), Path("docs/images/leaderboard.svg")
LABEL = {"rotation": -25, "ha": "left", "va": "top", "rotation_mode": "anchor"}
"""Labels run downwards, so that those of near points are apart."""


def leaderboard(
    *,
    build: Path = Path("build/learned"),
    predicted: Path = Path("build/learned-predicted"),
    none: Path = Path("build/learned-none"),
    kept: Path = KEPT,
    page: Path = PAGE,
    figure: Path = FIGURE,
) -> None:
    """Keep the results of `score`, `cost` and the trainings in one file, and write the page and its figure from it.

    Without new results, they are those of the kept file. Contenders that were trained and scored with the labels of
    `labels` are called `NAME, predicted labels` and `NAME, no labels`.

    Args:
        build: folder of the results.
        predicted: folder of the results with predicted labels.
        none: folder of the results without labels.
        kept: file of the kept results.
        page: page to write.
        figure: figure to write.
    """
    results = json.loads(kept.read_text())
    for folder, labels in ((build, ""), (predicted, ", predicted labels"), (none, ", no labels")):
        for path in sorted((folder / "scores").glob("*/*.json")):
            one = json.loads(path.read_text())
            kept_scores = results["scores"].setdefault(one["entry"] + labels, {})
            if any(other["weights"] != one["weights"] for other in kept_scores.values()):
                kept_scores.clear()  # of an earlier training
            kept_scores[one["test"]] = one
    if (build / "cost.json").is_file():
        results["costs"] |= json.loads((build / "cost.json").read_text())
    for path in sorted((build / "runs").glob(f"*/{SCORES_FILE}")):
        results["curves"][path.parent.name] = _curve(path)
    write_json(kept, results)
    write_text(page, Template(TEMPLATE.read_text()).render(tables.tables(results)) + "\n")
    _draw(results, figure)
    print(f"{page}, {figure}")


def _curve(path: Path) -> list[dict[str, float]]:
    """Return the learning curve of a run."""
    lines = map(json.loads, path.read_text().splitlines())
    return [{name: line[name] for name in ("images", "seconds", "recall_at_1")} for line in lines]


def _draw(results: Mapping[str, Any], path: Path) -> None:
    """Write the figure as SVG. The same results give the same bytes."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    times = {tables.method_of(name): cost["ms"] for name, cost in results["costs"].items()}
    left, right = figure.subplots(1, 2, sharey=True)
    for name, curve in results["curves"].items():
        left.plot([one["images"] for one in curve], [one["recall_at_1"] for one in curve], "o-", label=name)
    left.set(xscale="log", ylim=(0, 1.04), xlabel="images seen", ylabel="Recall@1", title="held-out town")
    left.legend(fontsize="x-small")
    for row in tables.rows(results["scores"]):
        if row.method in times and row.kind in ("", "trained") and (recalls := row.means(tables.TOWN)):
            point = times[row.method], np.mean(recalls)
            right.plot(*point, "o")
            right.annotate(row.title.replace("`", ""), point, fontsize="x-small", **LABEL)
    right.set(xscale="log", xlabel="milliseconds per descriptor", title="unseen town")
    with matplotlib.rc_context({"svg.hashsalt": "leaderboard", "svg.fonttype": "none"}), replacing(path) as temporary:
        figure.savefig(temporary, format="svg", metadata={"Date": None})
