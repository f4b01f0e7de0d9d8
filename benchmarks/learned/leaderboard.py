"""Writes the page that compares all contenders.

    python -m benchmarks.learned.leaderboard

Reads the results of `score`, `cost` and the trainings, keeps them in one file, and writes docs/leaderboard.md with its
figure from it. Without new results, they are those of the kept file. Contenders that were trained and scored with the
labels of `labels` are called `NAME, predicted labels` and `NAME, no labels`.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.learned.clock import stages
from benchmarks.learned.leaderboard_figure import draw
from benchmarks.learned.leaderboard_page import page_of
from sglpr_jax.cli.peers import RATES
from sglpr_jax.files import write_json, write_text
from sglpr_jax.training.learned.rate_search import RATES_FILE
from sglpr_jax.training.learned.run_files import SCORES_FILE

KEPT = Path(__file__).with_name("results.json")
PAGE, FIGURE = Path("docs/leaderboard.md"), Path("docs/images/leaderboard.svg")


def main(
    *,
    build: Path = Path("build/learned"),
    predicted: Path = Path("build/learned-predicted"),
    none: Path = Path("build/learned-none"),
    kept: Path = KEPT,
    page: Path = PAGE,
    figure: Path = FIGURE,
) -> None:
    """Keep new results, and write the page and its figure.

    Args:
        build: folder of the results.
        predicted: folder of the results with predicted labels.
        none: folder of the results without labels.
        kept: file of the kept results.
        page: page to write.
        figure: figure to write.
    """
    results = json.loads(kept.read_text()) if kept.is_file() else {"scores": {}, "costs": {}, "runs": {}}
    for folder, labels in ((build, ""), (predicted, ", predicted labels"), (none, ", no labels")):
        for path in sorted((folder / "scores").glob("*/*.json")):
            one = json.loads(path.read_text())
            results["scores"].setdefault(one["entry"] + labels, {})[one["test"]] = one
    if (build / "cost.json").is_file():
        results["costs"] |= json.loads((build / "cost.json").read_text())
    for path in sorted((build / "runs").glob(f"*/{SCORES_FILE}")):
        results["runs"][path.parent.name] = _run(path.parent)
    write_json(kept, results)
    write_text(page, page_of(results))
    draw(results, figure)


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


if __name__ == "__main__":
    tyro.cli(main)
