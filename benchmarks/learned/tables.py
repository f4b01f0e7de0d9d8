"""Tables of the leaderboard: all scores, the learning curves and the costs."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from benchmarks.learned.cells import (
    KITTI,
    LABELLED,
    SCENERIES,
    SENSORS,
    SEQS,
    SIMULATED,
    TOWN,
    Scores,
    finals,
    joined,
    mean,
    method_of,
    number,
    section,
    text,
    three,
)

MARKS_S = (225, 450, 900, 1800, 3600)
PUBLISHED_RECALL = {
    "BEVPlace": (0.997, 0.981, 1.000),
    "BEVPlace++": (0.999, 0.994, 1.000),
    "ResNet-34 + NetVLAD": (0.963, 0.841, 0.985),
    "OverlapTransformer": (0.967, 0.801, 0.956),
    "PointNetVLAD": (0.916, 0.623, 0.778),
}
"""Recall@1 on 00, 02 and 06 as published in the papers of BEVPlace and BEVPlace++."""


def summary(scores: Mapping[str, Scores], costs: Mapping[str, Any]) -> str:
    """Return the table of Recall@1 beside what it costs, the highest mean first."""
    by_method = {method_of(name): cost for name, cost in costs.items()}
    rows = []
    for name in finals({name: scores[name] for name in _by_recall(scores)}):
        found = scores[name]
        cost = by_method.get(method_of(name), {})
        seen = next(iter(found.values()))
        training = (number(seen["images"]), number(seen["seconds"]))
        recalls = (text(mean(found, column, "recall")) for column in (*SIMULATED, KITTI))
        size = (number(cost.get("ms"), 1), number(cost.get("bytes")))
        rows.append([f"`{name}`", *recalls, *training, *size])
    size_titles = ("description (ms)", "descriptor (bytes)")
    head = ["", *(column.title for column in (*SIMULATED, KITTI)), "images seen", "training (s)", *size_titles]
    about = """## Summary

Recall@1: the fraction of the revisits whose nearest descriptor, among frames older than 30 s, is within 5 m. Rows are
ordered by the mean of the columns from *town* to *other sensors*, where a missing cell counts as 0.
"""
    return section(about, head, rows)


def simulated(scores: Mapping[str, Scores]) -> str:
    """Return the table of all scores of simulated recordings."""
    columns = (TOWN, SCENERIES, SENSORS, TOWN.rotated, SCENERIES.rotated, SENSORS.rotated)
    rows = [
        [
            f"`{name}`",
            *(three(found, column) for column in columns),
            joined(mean(found, TOWN, f"verified {score}") for score in ("top1", "recall")),
        ]
        for name in _by_recall(scores)
        if mean(found := scores[name], TOWN, "recall") is not None
    ]
    about = """## Simulated recordings

Each cell: top-1 F1max, pairs F1max, Recall@1 ([protocols](concepts/protocols.md)). F1max ignores matches between 3 m
and 20 m, Recall@1 counts all beyond 5 m as wrong. *Verified*: `align` registers the 5 nearest places, and the one with
the highest correlation is the answer. This cell has top-1 F1max and Recall@1.
"""
    return section(about, ["", *(column.title for column in columns), "town, verified"], rows)


def kitti(scores: Mapping[str, Scores]) -> str:
    """Return the table of the images of KITTI."""
    columns = [each for one in SEQS for each in (one, one.rotated)]
    rows = [
        [f"`{name}`", *(three(scores[name], column) for column in columns)]
        for name in _by_recall(scores)
        if any(test in scores[name] for test in KITTI.tests)
    ]
    about = "## Images of KITTI\n\nEach cell: top-1 F1max, pairs F1max, Recall@1.\n"
    return section(about, ["", *(column.title for column in columns)], rows)


def published_recall(scores: Mapping[str, Scores]) -> str:
    """Return the table of Recall@1 by the published split into map and queries."""
    ours = {name: [mean(scores[name], column, "split recall") for column in SEQS] for name in _by_recall(scores)}
    rows = [[f"`{name}`", *map(text, found)] for name, found in ours.items() if any(found)]
    if rows:
        rows += [[f"{name}, published", *map(text, found)] for name, found in PUBLISHED_RECALL.items()]
    about = """## Beside published numbers

Recall@1 on the same images by the protocol of BEVPlace++: the first part of a sequence is the database, a later part
has the queries. So it differs from Recall@1 in the other tables. The published networks were trained on KITTI 00, and
those of BEVPlace start from ImageNet. The networks here were trained on simulated recordings.
"""
    return section(about, ["", *(column.title for column in SEQS)], rows)


def along_trainings(runs: Mapping[str, Any]) -> Iterator[str]:
    """Yield the tables of Recall@1 on the held-out town along the trainings."""
    curves = {name: run["curve"] for name, run in runs.items() if run["curve"]}
    marks = [1000 * 2**k for k in range(8)]
    rates = {name: (runs[name]["rates"] or {"best": None})["best"] for name in curves}
    rows = [
        [f"`{name}`", "-" if rates[name] is None else f"{rates[name]:.2g}", *(_after(curve, mark) for mark in marks)]
        for name, curve in curves.items()
    ]
    about = "## Along the training\n\nRecall@1 on the held-out town after numbers of images.\n"
    yield section(about, ["", "searched learning rate", *(f"{mark:,}" for mark in marks)], rows)
    rows = [
        [
            f"`{name}`",
            *(_until(curve, mark) for mark in MARKS_S),
            text(curve[-1]["recall_at_1"]),
            number(curve[-1]["images"]),
            number(curve[-1]["seconds"]),
            ", ".join(f"{loss:.3g}" for loss in runs[name]["losses"] or ()) or "-",
        ]
        for name, curve in curves.items()
    ]
    about = """The same after seconds: the score of the last snapshot before. Then the score, the images and the seconds
at the end, and the mean loss of each quarter of the steps.
"""
    yield section(about, ["", *map(str, MARKS_S), "end", "images", "seconds", "loss"], rows)


def _after(curve: Sequence[Mapping[str, float]], images: int) -> str:
    found = next((one for one in curve if images <= one["images"] < 1.5 * images), None)
    return text(None if found is None else found["recall_at_1"])


def _until(curve: Sequence[Mapping[str, float]], seconds: float) -> str:
    found = [one for one in curve if one["seconds"] <= 1.01 * seconds]
    finished = seconds <= 1.01 * curve[-1]["seconds"]
    return text(found[-1]["recall_at_1"] if found and finished else None)


def costs(costs: Mapping[str, Any]) -> str:
    """Return the table of times and sizes."""
    digits = {"ms": 1, "bytes": 0, "weights": 0, "gflop": 3}
    rows = [
        [f"`{method_of(name)}`", *(number(cost.get(key), each) for key, each in digits.items())]
        for name, cost in costs.items()
    ]
    about = "## Cost\n\nFrom a scan in memory to its descriptor, one scan at a time on one core.\n"
    return section(about, ["", "ms", "bytes", "weights", "GFLOP"], rows)


def _by_recall(scores: Mapping[str, Scores]) -> list[str]:
    """Return the contenders, the highest mean Recall@1 first. Missing recordings count as 0."""
    means = {name: sum(mean(found, one, "recall") or 0 for one in LABELLED) for name, found in scores.items()}
    return sorted(scores, key=lambda name: -means[name])
