"""The text of the page that compares all contenders."""

import itertools
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
    TRAINED_TOWN,
    Column,
    Scores,
    both,
    finals,
    joined,
    mean,
    method_of,
    number,
    section,
    text,
    three,
)
from sglpr_jax.evaluation.published import TABLE_1

OURS = "sglpr-0"
"""The run that the peers are compared with at equal numbers of images."""
AHEAD = 0.005
"""Difference of two scores from which a contender is ahead."""
FAR = 0.1
"""Difference by which a trained network is far above a baseline."""
REVERSED = 0.02
"""Difference from which two means are in an order."""
MARKS_S = (225, 450, 900, 1800, 3600)
PUBLISHED_RECALL = {
    "BEVPlace": (0.997, 0.981, 1.000),
    "BEVPlace++": (0.999, 0.994, 1.000),
    "ResNet-34 + NetVLAD": (0.963, 0.841, 0.985),
    "OverlapTransformer": (0.967, 0.801, 0.956),
    "PointNetVLAD": (0.916, 0.623, 0.778),
}
"""Recall@1 on 00, 02 and 06 as published in the papers of BEVPlace and BEVPlace++."""
PUBLISHED_NAMES = {
    "m2dp": "M2DP",
    "scan-context": "Scan Context",
    "lidar-iris": "LiDAR Iris",
    "ssc": "SSC",
    "pointnetvlad-0": "PointNetVLAD",
    "overlap-transformer-0": "OverlapTransformer",
    "disco-0": "DiSCO",
    "sgpr-0": "SGPR",
    "rinet-0": "RINet",
    "paper-112-0": "SG-LPR",
}
"""Contenders that are rows of the paper's table 1."""
LABELS = {
    "rinet-0": "true",
    "rinet-0/weights-1024000": "true",
    "rinet-0, predicted labels": "predicted",
    "rinet-0, no labels": "none",
    "sgpr-0": "true",
    "sgpr-0, predicted labels": "predicted",
    "sgpr-0, no labels": "none",
    "sglpr-0": "true, while training",
    "sglpr-no-labels-0": "none",
}
"""Contenders, and the labels that they have."""
HEAD = """# Leaderboard

All networks were trained on the same simulated recordings, each for one hour on one core, while the second core trained
another network. They start from random weights. The learning rate was chosen by three short trainings, scored on a
held-out town. The tables along the training are of this town, all others of recordings that nothing was chosen on.

* Three trainings have no rate of a search. `paper-112-0` has 9,000 s, a first stage without rotations, and the rate
  4e-4, with which an earlier training learned. `bevplace++-0` has the rate of `resnet34-netvlad-0`, the same network
  with one rotation. `sgpr-0` has the rate 3e-4. In its search all scores were below 0.07, and 3e-4 had the lowest loss.
* `NAME-0` and `NAME-1` are two seeds. `random:0` are untrained networks.
* `sglpr` and `circular` are the shipped weights, which were trained longer and on more towns. `sglpr-0` has the
  training of the others.
* `bevplace++@resnet34-netvlad-0` describes eight rotations with the weights of one.

`python -m benchmarks.learned.leaderboard` writes this page from `benchmarks/learned/results.json`. The
[guide](guides/peers.md#all-methods-on-equal-terms) has the commands. Missing cells were not measured, and networks
without a row were not trained yet.
"""
FIGURE = """![Recall@1 against images seen, and against milliseconds](images/leaderboard.svg)
"""


def page_of(results: Mapping[str, Any]) -> str:
    """Return the page of kept results."""
    scores, runs, costs = results["scores"], results["runs"], results["costs"]
    parts = [HEAD, FIGURE, _summary(scores, costs), _equal_images(scores), _baselines(scores), _semantics(scores)]
    parts += [_orders(scores), _simulated(scores), _kitti(scores), _split(scores), *_curves(runs), _costs(costs)]
    return "\n".join(part for part in parts if part)


def _summary(scores: Mapping[str, Scores], costs: Mapping[str, Any]) -> str:
    """Return the table of Recall@1 beside what it costs, the highest mean first."""
    by_method = {method_of(name): cost for name, cost in costs.items()}
    rows = []
    for name in sorted(finals(scores), key=lambda name: -_overall(scores[name])):
        found = scores[name]
        cost = by_method.get(method_of(name), {})
        seen = next(iter(found.values()))
        training = (number(seen["images"]), number(seen["seconds"]))
        recalls = (text(mean(found, column, "recall")) for column in (*SIMULATED, KITTI))
        size = (number(cost.get("ms"), 1), number(cost.get("bytes")))
        rows.append([f"`{name}`", *recalls, *training, *size])
    head = ["", *(column.title for column in (*SIMULATED, KITTI)), "images seen", "seconds", "ms", "bytes"]
    about = """## Summary

Recall@1: the fraction of the revisits whose nearest descriptor, among frames older than 30 s, is within 5 m. *Another
day* searches a first session for the scans of a second one. Then images and seconds of the training, and time and size
of a descriptor.
"""
    return section(about, head, rows)


def _equal_images(scores: Mapping[str, Scores]) -> str:
    """Return the table of each peer beside our network after at most as many images, and who is ahead."""
    snapshots = {_images(scores[name]): name for name in scores if name.split("/")[0] == OURS}
    rows, ahead = [], []
    for name in finals(scores):
        fitting = [count for count in snapshots if 0 < count <= _images(scores[name])]
        if name == OURS or not fitting:
            continue
        theirs, ours = scores[name], scores[snapshots[max(fitting)]]
        cells = [(column, mean(theirs, column, "recall"), mean(ours, column, "recall")) for column in SIMULATED]
        titles = [column.title for column, a, b in cells if a and b and a >= b + AHEAD]
        ahead += [f"`{name}` ({'all columns' if len(titles) == len(cells) else '; '.join(titles)})"] if titles else []
        rows.append([f"`{name}`", f"{_images(theirs):,}", f"{max(fitting):,}", *(both(a, b) for _, a, b in cells)])
    head = ["", "its images", f"images of `{OURS}`", *(column.title for column in SIMULATED)]
    about = f"""## At equal numbers of images

Recall@1 of each network / of `{OURS}` after at most as many images. RINet and SGPR have the true label of each point.
Ahead of `{OURS}` by {AHEAD} or more: {", ".join(ahead) or "none"}.
"""
    return section(about, head, rows)


def _baselines(scores: Mapping[str, Scores]) -> str:
    """Return the table of each network beside its untrained self and the thumbnail, and who is not far above both."""
    rows, near = [], []
    for name in finals(scores):
        untrained = scores.get(f"{method_of(name)}@random:0", {})
        recall = mean(scores[name], TOWN, "recall")
        if not _images(scores[name]) or recall is None:
            continue
        baselines = [mean(one, TOWN, "recall") for one in (untrained, scores.get("thumbnail", {}))]
        near += [f"`{name}`"] if any(one is not None and recall < one + FAR for one in baselines) else []
        ways = (text(mean(scores[name], Column("", (test,)), "recall")) for test in TOWN.tests)
        known = (
            both(*(mean(one, Column("", (test,)), "recall") for one in (scores[name], untrained)))
            for test in TRAINED_TOWN
        )
        rows.append([f"`{name}`", text(recall), *map(text, baselines), *ways, *known])
    about = f"""## Beside untrained networks and the thumbnail

Recall@1 in the unseen town, then the same for revisits in the same direction and in the opposite one. The last two
columns are a town of the training: trained / untrained.
Not above both baselines by {FAR} or more: {", ".join(near) or "none"}.

* `overlap-transformer-0` has learned nothing in its hour: in a town of its training, it is not ahead of its untrained
  self. The published training takes 100 epochs of KITTI.
* `pointnetvlad-0` gains in the same direction only. It finds no revisit in the opposite direction in a town of its
  training either, although the training rotates the scans. The published training takes 20 epochs of Oxford.
"""
    head = ["", "trained", "untrained", "thumbnail", "same", "opposite", "training, same", "training, opposite"]
    return section(about, head, rows)


def _semantics(scores: Mapping[str, Scores]) -> str:
    """Return the table of what labels are worth."""
    rows = [
        [
            f"`{method_of(name.split(',')[0])}`",
            labels,
            number(_images(scores[name])),
            *(text(mean(scores[name], column, "recall")) for column in LABELLED),
        ]
        for name, labels in LABELS.items()
        if name in scores
    ]
    about = """## What labels are worth

Recall@1. RINet and SGPR need a label for each point: the true one, that of the segmentation head of `sglpr`, or one and
the same for all points. `sglpr` needs labels only while training, for its segmentation head.
"""
    return section(about, ["", "labels", "images seen", *(column.title for column in LABELLED)], rows)


def _orders(scores: Mapping[str, Scores]) -> str:
    """Return the published orders of two methods that are reversed here."""
    known = [(name, _row(title)) for name, title in PUBLISHED_NAMES.items() if name in scores]
    pairs, rows = 0, []
    for (name, row), (other, against) in itertools.permutations(known, 2):
        score = "pairs" if row.f1max_protocol == "pairs-f1max" else "top1"
        here, there = mean(scores[name], TOWN, score), mean(scores[other], TOWN, score)
        if row.f1max_protocol != against.f1max_protocol or here is None or there is None:
            continue
        if row.mean >= against.mean + REVERSED:
            pairs += 1
            if here <= there - REVERSED:
                rows.append([f"{row.method}, {against.method}", both(row.mean, against.mean), both(here, there)])
    about = f"""## Published orders that do not hold here

Two methods of the paper's table 1 with the same protocol, the mean of its row, and F1max by this protocol in the unseen
town. Of {pairs} pairs whose means differ by {REVERSED} or more, these are reversed by as much:
"""
    return section(about, ["", "published", "here"], rows)


def _row(title: str) -> Any:
    return next(row for row in TABLE_1.rows if row.method == title)


def _simulated(scores: Mapping[str, Scores]) -> str:
    """Return the table of all scores of simulated recordings."""
    columns = (TOWN, SCENERIES, SENSORS, TOWN.rotated, SCENERIES.rotated, SENSORS.rotated)
    rows = [
        [
            f"`{name}`",
            *(three(found, column) for column in columns),
            joined(mean(found, TOWN, f"verified {score}") for score in ("top1", "recall")),
        ]
        for name, found in scores.items()
        if mean(found, TOWN, "recall") is not None
    ]
    about = """## Simulated recordings

Top-1 F1max, pairs F1max, Recall@1. *Verified* is top-1 F1max and Recall@1 of the best of the 5 nearest places by the
correlation of `align`.
"""
    return section(about, ["", *(column.title for column in columns), "town, verified"], rows)


def _kitti(scores: Mapping[str, Scores]) -> str:
    """Return the table of the images of KITTI."""
    columns = [each for one in SEQS for each in (one, one.rotated)]
    rows = [
        [f"`{name}`", *(three(found, column) for column in columns)]
        for name, found in scores.items()
        if any(test in found for test in KITTI.tests)
    ]
    about = "## Images of KITTI\n\nTop-1 F1max, pairs F1max, Recall@1.\n"
    return section(about, ["", *(column.title for column in columns)], rows)


def _split(scores: Mapping[str, Scores]) -> str:
    """Return the table of Recall@1 by the published split into map and queries."""
    ours = {name: [mean(found, column, "split recall") for column in SEQS] for name, found in scores.items()}
    rows = [[f"`{name}`", *map(text, found)] for name, found in ours.items() if any(found)]
    if rows:
        rows += [[f"{name}, published", *map(text, found)] for name, found in PUBLISHED_RECALL.items()]
    about = """## Beside published numbers

Recall@1 of the same images by the split of BEVPlace++. The published networks were trained on KITTI 00 itself, for far
longer. Those of BEVPlace start from ImageNet.
"""
    return section(about, ["", *(column.title for column in SEQS)], rows)


def _curves(runs: Mapping[str, Any]) -> Iterator[str]:
    """Yield the tables of Recall@1 on the held-out town along the trainings."""
    curves = {name: run["curve"] for name, run in runs.items() if run["curve"]}
    marks = [1000 * 2**k for k in range(8)]
    rates = {name: (runs[name]["rates"] or {"best": None})["best"] for name in curves}
    rows = [
        [f"`{name}`", "-" if rates[name] is None else f"{rates[name]:.2g}", *(_after(curve, mark) for mark in marks)]
        for name, curve in curves.items()
    ]
    about = "## Along the training\n\nRecall@1 on the held-out town after numbers of images.\n"
    yield section(about, ["", "learning rate", *(f"{mark:,}" for mark in marks)], rows)
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
    about = """The same after seconds: the last weights that were kept until then. Then the score, the images and the
seconds at the end, and the mean loss of each quarter of the steps.
"""
    yield section(about, ["", *map(str, MARKS_S), "end", "images", "seconds", "loss"], rows)


def _after(curve: Sequence[Mapping[str, float]], images: int) -> str:
    found = next((one for one in curve if images <= one["images"] < 1.5 * images), None)
    return text(None if found is None else found["recall_at_1"])


def _until(curve: Sequence[Mapping[str, float]], seconds: float) -> str:
    found = [one for one in curve if one["seconds"] <= 1.01 * seconds]
    finished = seconds <= 1.01 * curve[-1]["seconds"]
    return text(found[-1]["recall_at_1"] if found and finished else None)


def _costs(costs: Mapping[str, Any]) -> str:
    """Return the table of times and sizes."""
    digits = {"ms": 1, "bytes": 0, "weights": 0, "gflop": 2}
    rows = [
        [f"`{method_of(name)}`", *(number(cost.get(key), each) for key, each in digits.items())]
        for name, cost in costs.items()
    ]
    about = "## Cost\n\nFrom a scan in memory to its descriptor, one scan at a time on one core.\n"
    return section(about, ["", "ms", "bytes", "weights", "GFLOP"], rows)


def _images(found: Scores) -> int:
    return next(iter(found.values()))["images"] or 0


def _overall(found: Scores) -> float:
    """Return the mean Recall@1 over the simulated recordings; missing ones count as 0."""
    return sum(mean(found, column, "recall") or 0 for column in SIMULATED) / len(SIMULATED)
