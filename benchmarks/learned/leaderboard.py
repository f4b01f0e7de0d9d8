"""Writes the page that compares all contenders.

    python -m benchmarks.learned.leaderboard

Reads the results of `score`, `cost` and the trainings, keeps them in one file, and writes docs/leaderboard.md from it.
Without new results, the page is that of the kept file.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import tyro

from sglpr_jax.files import write_json, write_text

KEPT = Path(__file__).with_name("results.json")
PAGE = Path("docs/leaderboard.md")
GROUPS = {
    "town": ("town-601-00", "town-601-08"),
    "other sceneries": ("outskirts-602-08", "lanes-602-08", "car_park-602-08"),
    "other sensors": ("vlp16-603-08", "os1-64-603-08"),
}
"""Columns of the first table: means over these recordings."""
SEQS = ("00", "02", "06")
PUBLISHED = {
    "BEVPlace": (0.997, 0.981, 1.000),
    "BEVPlace++": (0.999, 0.994, 1.000),
    "ResNet-34 + NetVLAD": (0.963, 0.841, 0.985),
    "OverlapTransformer": (0.967, 0.801, 0.956),
    "PointNetVLAD": (0.916, 0.623, 0.778),
}
"""Recall@1 on 00, 02 and 06 as published in the papers of BEVPlace and BEVPlace++."""
HEAD = """# Leaderboard

All networks were trained by the same program on the same simulated recordings, each on one core, with a learning rate
chosen by three short trainings on a held-out town. They start from random weights.

* `NAME-0` and `NAME-1` are two seeds. `random:0` are untrained networks.
* `sglpr` and `circular` are the shipped weights, which were trained longer and on more towns. `sglpr-0` has the
  training of the others.
* `bevplace++@resnet34-netvlad-0` describes eight rotations with the weights of one.

`python -m benchmarks.learned.leaderboard` writes this page from `benchmarks/learned/results.json`. The
[guide](guides/peers.md#all-methods-on-equal-terms) has the commands. Missing cells were not measured, and networks
without a row were not trained yet.
"""


def main(*, build: Path = Path("build/learned"), kept: Path = KEPT, page: Path = PAGE) -> None:
    """Keep new results and write the page.

    Args:
        build: folder of the results.
        kept: file of the kept results.
        page: page to write.
    """
    results = json.loads(kept.read_text()) if kept.is_file() else {"scores": {}, "costs": {}, "runs": {}}
    for path in sorted((build / "scores").glob("*/*.json")):
        one = json.loads(path.read_text())
        results["scores"].setdefault(one["entry"], {})[one["test"]] = one
    if (build / "cost.json").is_file():
        results["costs"] |= json.loads((build / "cost.json").read_text())
    for path in sorted((build / "runs").glob("*/scores.jsonl")):
        results["runs"][path.parent.name] = _run(path.parent)
    write_json(kept, results)
    write_text(page, page_of(results))


def _run(folder: Path) -> dict[str, Any]:
    """Return the learning curve of a run and the search of its learning rate."""
    lines = [json.loads(line) for line in (folder / "scores.jsonl").read_text().splitlines()]
    curve = [{name: line[name] for name in ("images", "seconds", "recall_at_1")} for line in lines]
    rates = folder / "rates" / "rates.json"
    return {"curve": curve, "rates": json.loads(rates.read_text()) if rates.is_file() else None}


def page_of(results: Mapping[str, Any]) -> str:
    """Return the page of kept results."""
    scores, runs = results["scores"], results["runs"]
    parts = [HEAD, _simulated(scores), _kitti(scores), _published(scores), _curves(runs), _costs(results["costs"])]
    return "\n".join(part for part in parts if part)


def _simulated(scores: Mapping[str, Any]) -> str:
    """Return the table of unseen simulated recordings, the highest Recall@1 in a town first."""
    names = sorted(scores, key=lambda name: -(_mean(scores[name], GROUPS["town"], "recall") or 0))
    rows = [
        [
            f"`{name}`",
            *(_three(scores[name], tests) for tests in GROUPS.values()),
            *(_three(scores[name], [f"{test}-rotated" for test in tests]) for tests in GROUPS.values()),
            _text(_mean(scores[name], ["days-604"], "recall")),
            _pair(scores[name], GROUPS["town"]),
        ]
        for name in names
        if _mean(scores[name], GROUPS["town"], "recall") is not None
    ]
    head = ["", *GROUPS, *(f"{name}, rotated" for name in GROUPS), "another day", "town, verified"]
    about = """## Simulated recordings

Unseen towns: top-1 F1max, pairs F1max, Recall@1 within 5 m. *Another day* is the Recall@1 of a second session in a
first one. *Verified* is top-1 F1max and Recall@1 of the best of the 5 nearest places by the correlation of `align`.
"""
    return f"{about}\n{_table(head, rows)}\n"


def _kitti(scores: Mapping[str, Any]) -> str:
    """Return the table of the images of KITTI."""
    tests = [f"kitti-{seq}" for seq in SEQS]
    rows = [
        [f"`{name}`", *(_three(found, [test]) for one in tests for test in (one, f"{one}-rotated"))]
        for name, found in scores.items()
        if any(test in found for test in tests)
    ]
    head = ["", *(text for seq in SEQS for text in (seq, f"{seq}, rotated"))]
    return (
        f"## Images of KITTI\n\nTop-1 F1max, pairs F1max, Recall@1 within 5 m.\n\n{_table(head, rows)}\n"
        if rows
        else ""
    )


def _published(scores: Mapping[str, Any]) -> str:
    """Return the table of Recall@1 by the published split into map and queries."""
    rows = [
        [f"`{name}`", *(_text(_mean(found, [f"kitti-{seq}"], "split recall")) for seq in SEQS)]
        for name, found in scores.items()
        if any("split recall" in found.get(f"kitti-{seq}", {"scores": {}})["scores"] for seq in SEQS)
    ]
    if not rows:
        return ""
    rows += [[f"{name}, published", *(f"{score:.3f}" for score in found)] for name, found in PUBLISHED.items()]
    about = """## Beside published numbers

Recall@1 of the same images by the split of BEVPlace++. The published networks were trained on KITTI 00 itself, for far
longer. Those of BEVPlace start from ImageNet.
"""
    return f"{about}\n{_table(['', *SEQS], rows)}\n"


def _curves(runs: Mapping[str, Any]) -> str:
    """Return the table of Recall@1 on the held-out town along the trainings."""
    marks = [1000 * 2**k for k in range(8)]
    rows = []
    for name, run in runs.items():
        curve, rates = run["curve"], run["rates"] or {"best": "-"}
        if not curve:
            continue
        at = {mark: next((one for one in curve if mark <= one["images"] < 1.5 * mark), None) for mark in marks}
        cells = ["-" if one is None else f"{one['recall_at_1']:.3f}" for one in at.values()]
        last = curve[-1]
        ends = (f"{last['images']:.0f}", f"{last['seconds']:.0f}", f"{last['recall_at_1']:.3f}")
        rows.append([f"`{name}`", f"{rates['best']}", *cells, *ends])
    head = ["", "rate", *(f"{mark:,}" for mark in marks), "images", "seconds", "Recall@1"]
    about = "## Along the training\n\nRecall@1 on the held-out town after numbers of images, and at the end."
    return f"{about}\n\n{_table(head, rows)}\n" if rows else ""


def _costs(costs: Mapping[str, Any]) -> str:
    """Return the table of times and sizes."""
    formats: Mapping[str, Callable[[Any], str]] = {
        "ms": "{:.1f}".format,
        "bytes": "{:,}".format,
        "weights": "{:,}".format,
        "gflop": "{:.2f}".format,
    }
    rows = [
        [f"`{name.split('@')[0]}`", *(write(cost[key]) if key in cost else "-" for key, write in formats.items())]
        for name, cost in costs.items()
    ]
    head = ["", "ms", "bytes", "weights", "GFLOP"]
    about = "## Cost\n\nFrom a scan in memory to its descriptor, one scan at a time on one core."
    return f"{about}\n\n{_table(head, rows)}\n" if rows else ""


def _mean(found: Mapping[str, Any], tests: Iterable[str], score: str) -> float | None:
    """Return the mean of a score over recordings, or None if one is missing."""
    values = [found[test]["scores"].get(score) if test in found else None for test in tests]
    return None if None in values else sum(values) / len(values)  # type: ignore[arg-type]


def _three(found: Mapping[str, Any], tests: Sequence[str]) -> str:
    return _joined(_mean(found, tests, score) for score in ("top1", "pairs", "recall"))


def _pair(found: Mapping[str, Any], tests: Sequence[str]) -> str:
    return _joined(_mean(found, tests, f"verified {score}") for score in ("top1", "recall"))


def _joined(values: Iterable[float | None]) -> str:
    texts = [_text(value) for value in values]
    return "-" if set(texts) == {"-"} else ", ".join(texts)


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))


if __name__ == "__main__":
    tyro.cli(main)
