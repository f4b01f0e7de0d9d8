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
from benchmarks.learned.train import stages
from sglpr_jax.cli.peers import RATES
from sglpr_jax.files import replacing, write_json, write_text
from sglpr_jax.training.peers import RATES_FILE
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
        results["runs"][path.parent.name] = _run(path.parent)
    write_json(kept, results)
    write_text(page, Template(TEMPLATE.read_text()).render(tables.tables(results)) + "\n")
    _draw(results, figure)
    print(f"{page}, {figure}")


def _run(folder: Path) -> dict[str, Any]:
    """Return the learning curve of a run, its losses in all stages, and the search of its learning rate."""
    lines = [json.loads(line) for line in (folder / SCORES_FILE).read_text().splitlines()]
    curve = [{name: line[name] for name in ("images", "seconds", "recall_at_1")} for line in lines]
    logged = [json.loads(line) for path in stages(folder) for line in path.read_text().splitlines()]
    losses = [line["loss"] for line in logged if "loss" in line]
    quarters = [float(np.mean(part)) for part in np.array_split(losses, 4)] if len(losses) >= 4 else None
    rates = folder / RATES / RATES_FILE
    found = json.loads(rates.read_text()) if rates.is_file() else None
    return {"curve": curve, "losses": quarters, "rates": found}


def _draw(results: Mapping[str, Any], path: Path) -> None:
    """Write the figure as SVG. The same results give the same bytes."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    times = {tables.method_of(name): cost["ms"] for name, cost in results["costs"].items()}
    left, right = figure.subplots(1, 2, sharey=True)
    for name, run in results["runs"].items():
        curve = run["curve"]
        left.plot([one["images"] for one in curve], [one["recall_at_1"] for one in curve], "o-", label=name)
    left.set(xscale="log", ylim=(0, 1.04), xlabel="images seen", ylabel="Recall@1", title="held-out town")
    left.legend(fontsize="x-small")
    for row in tables.rows(results["scores"]):
        name, _, kind = row.title.replace("`", "").partition(", ")
        if name in times and kind in ("", "trained") and (recalls := row.means(tables.TOWN)):
            right.plot(times[name], np.mean(recalls), "o")
            right.annotate(row.title.replace("`", ""), (times[name], np.mean(recalls)), fontsize="x-small", **LABEL)
    right.set(xscale="log", xlabel="milliseconds per descriptor", title="unseen town")
    with matplotlib.rc_context({"svg.hashsalt": "leaderboard", "svg.fonttype": "none"}), replacing(path) as temporary:
        figure.savefig(temporary, format="svg", metadata={"Date": None})
