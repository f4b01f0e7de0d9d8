"""Tables of the leaderboard: scores, learning curves, costs, and comparisons of contenders."""

import itertools
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from sglpr_jax.evaluation.published import TABLE_1

Scores = Mapping[str, Mapping[str, Any]]
"""Results of one contender, by test recording."""
SCORES = ("top1", "pairs", "recall")
"""Top-1 F1max, pairs F1max and Recall@1."""
MARKS_S = (225, 450, 900, 1800, 3600)
PUBLISHED_RECALL = {
    "BEVPlace": (0.997, 0.981, 1.000),
    "BEVPlace++": (0.999, 0.994, 1.000),
    "ResNet-34 + NetVLAD": (0.963, 0.841, 0.985),
    "OverlapTransformer": (0.967, 0.801, 0.956),
    "PointNetVLAD": (0.916, 0.623, 0.778),
}
"""Recall@1 on 00, 02 and 06 as published in the papers of BEVPlace and BEVPlace++."""
OURS = "sglpr-0"
"""The run that the peers are compared with."""
AHEAD = 0.005
"""Difference of two scores from which a contender is ahead."""
NEARLY = 1.5
"""Largest ratio of two numbers of images that are compared."""
FAR = 0.1
"""Difference by which a trained network is far above its untrained self."""
REVERSED = 0.02
"""Difference from which two means are in an order."""
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
    "rinet-0, no labels": "one for all points",
    "sgpr-0": "true",
    "sgpr-0, predicted labels": "predicted",
    "sgpr-0, no labels": "one for all points",
    "sglpr-0": "true, while training",
    "sglpr-0/weights-16000": "true, while training",
    "sglpr-no-labels-0": "none",
}
"""Contenders, and the labels that they have."""


class Column(NamedTuple):
    """A mean over test recordings."""

    title: str
    tests: tuple[str, ...]

    @property
    def rotated(self) -> "Column":
        """The same recordings with rotated scans."""
        return Column(f"{self.title}, rotated", tuple(f"{test}-rotated" for test in self.tests))


TOWN = Column("town", ("town-601-00", "town-601-08"))
TRAINED_TOWN = ("town-10-00", "town-10-08")
"""Revisits in the same and in the opposite direction in a town of the training."""
SCENERIES = Column("other sceneries", ("outskirts-602-08", "lanes-602-08", "car_park-602-08"))
SENSORS = Column("other sensors", ("vlp16-603-08", "os1-64-603-08"))
UNSEEN_SENSOR = Column("unseen sensor", ("xt32-603-08",))
LANE = Column("other lane", ("aside-3-601-00-in-town-601-00", "aside-3-601-08-in-town-601-08"))
WALKS = Column("walks", ("campus-605-08", "yard-605-08"))
DAY = Column("another day", ("days-604",))
PLACES = (TOWN, SCENERIES, SENSORS)
LABELLED = (TOWN, TOWN.rotated, SCENERIES, SENSORS)
"""The columns of which all methods have scores."""
SIMULATED = (*LABELLED, UNSEEN_SENSOR, LANE, WALKS, DAY)
SEQS = tuple(Column(seq, (f"kitti-{seq}",)) for seq in ("00", "02", "06"))
KITTI = Column("KITTI", tuple(test for column in SEQS for test in column.tests))


def method_of(name: str) -> str:
    """The method of a contender: `rinet` of `rinet-0/weights-1000` and of `rinet@random:0`."""
    return re.sub(r"-\d$", "", name.split("/")[0].split("@")[0])


def finals(scores: Mapping[str, Scores]) -> list[str]:
    """The contenders, without the weights along a training and those with other labels."""
    return [name for name in scores if "/" not in name and "," not in name]


def images_of(results: Scores) -> int:
    """The number of images that a contender was trained with."""
    return next(iter(results.values()))["images"] or 0


def mean(results: Scores, column: Column, score: str = "recall") -> float | None:
    """The mean of a score over recordings, or None if one is missing."""
    values = [results[test]["scores"].get(score) if test in results else None for test in column.tests]
    return None if None in values else sum(values) / len(values)  # type: ignore[arg-type]


def text(*values: float | None) -> str:
    """A cell of scores to compare."""
    return " / ".join("-" if value is None else f"{value:.3f}" for value in values)


def number(value: float | None, digits: int = 0) -> str:
    """A number as a cell."""
    return "-" if value is None else f"{value:,.{digits}f}"


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))


def titles(columns: Sequence[Column]) -> list[str]:
    """Titles of columns."""
    return [column.title for column in columns]


def tables(results: Mapping[str, Any]) -> dict[str, Any]:
    """Values of the page's template: its tables, and facts in its text."""
    scores, costs = results["scores"], results["costs"]
    sums = {name: sum(mean(one, column) or 0 for column in LABELLED) for name, one in scores.items()}
    by_recall = {name: scores[name] for name in sorted(scores, key=lambda name: -sums[name])}
    finished = [name for name in finals(scores) if images_of(scores[name]) and not name.startswith("sglpr")]
    values = {
        ("after_training", "ahead_after_training"): _beside_ours(scores, [(name, OURS) for name in finished]),
        ("equal_images", "ahead_at_equal_images"): _beside_ours(
            scores, [pair for name in finished if (pair := _equal_images(scores, name))]
        ),
        ("baselines", "near_baselines"): _baselines(scores),
        ("published_orders", "published_pairs"): _published_orders(scores),
        ("by_images", "by_seconds"): _along_trainings(results["runs"]),
        ("simulated", "kitti"): (
            _all_scores(by_recall, [*PLACES, *(column.rotated for column in PLACES)], verified=True),
            _all_scores(by_recall, [column for seq in SEQS for column in (seq, seq.rotated)]),
        ),
        ("summary", "costs"): (_summary(by_recall, costs), _costs(costs)),
        ("labels", "published_recall"): (_labels(scores), _published_recall(by_recall)),
    }
    return {name: value for names, pair in values.items() for name, value in zip(names, pair, strict=True)}


def _summary(scores: Mapping[str, Scores], costs: Mapping[str, Any]) -> str:
    """Recall@1 beside what it costs."""
    by_method, columns = {method_of(name): cost for name, cost in costs.items()}, (*SIMULATED, KITTI)
    rows = []
    for name in finals(scores):
        cost, result = by_method.get(method_of(name), {}), next(iter(scores[name].values()))
        numbers = (
            number(result["images"]),
            number(result["seconds"]),
            number(cost.get("ms"), 1),
            number(cost.get("bytes")),
        )
        rows.append([f"`{name}`", *(text(mean(scores[name], column)) for column in columns), *numbers])
    more = ("images seen", "training (s)", "description (ms)", "descriptor (bytes)")
    return markdown(["", *titles(columns), *more], rows)


def _all_scores(scores: Mapping[str, Scores], columns: Sequence[Column], *, verified: bool = False) -> str:
    """All scores of the contenders that have one in these columns, and those of the town after verification."""

    def cell(results: Scores, column: Column, *names: str) -> str:
        values = [mean(results, column, name) for name in names]
        return "-" if set(values) == {None} else ", ".join(map(text, values))

    rows = []
    for name, results in scores.items():
        if any(mean(results, column) is not None for column in columns):
            cells = [cell(results, column, *SCORES) for column in columns]
            cells += [cell(results, TOWN, "verified top1", "verified recall")] if verified else []
            rows.append([f"`{name}`", *cells])
    return markdown(["", *titles(columns), *(["town, verified"] if verified else [])], rows)


def _published_recall(scores: Mapping[str, Scores]) -> str:
    """Recall@1 by the published split into map and queries."""
    ours = {f"`{name}`": [mean(one, column, "split recall") for column in SEQS] for name, one in scores.items()}
    published = {f"{name}, published": values for name, values in PUBLISHED_RECALL.items()}
    rows = [[name, *map(text, values)] for name, values in (ours | published).items() if any(values)]
    return markdown(["", *titles(SEQS)], rows)


def _along_trainings(runs: Mapping[str, Any]) -> tuple[str, str]:
    """Recall@1 on the held-out town along the trainings, by images and by seconds."""

    def recall(snapshots: Sequence[Mapping[str, float]]) -> str:
        return text(snapshots[0]["recall_at_1"] if snapshots else None)

    marks, by_images, by_seconds = [1000 * 2**k for k in range(8)], [], []
    for name, run in runs.items():
        if curve := run["curve"]:
            rate, end = (run["rates"] or {"best": None})["best"], curve[-1]
            searched = "-" if rate is None else f"{rate:.2g}"
            after = ([one for one in curve if mark <= one["images"] < 1.5 * mark] for mark in marks)
            until = (
                [one for one in curve if one["seconds"] <= 1.01 * mark] if mark <= 1.01 * end["seconds"] else []
                for mark in MARKS_S
            )
            by_images.append([f"`{name}`", searched, *(recall(snapshots[:1]) for snapshots in after)])
            numbers = (text(end["recall_at_1"]), number(end["images"]), number(end["seconds"]))
            losses = ", ".join(f"{loss:.3g}" for loss in run["losses"] or ()) or "-"
            by_seconds.append([f"`{name}`", *(recall(snapshots[-1:]) for snapshots in until), *numbers, losses])
    return (
        markdown(["", "searched learning rate", *(f"{mark:,}" for mark in marks)], by_images),
        markdown(["", *map(str, MARKS_S), "end", "images", "seconds", "loss"], by_seconds),
    )


def _costs(costs: Mapping[str, Any]) -> str:
    """Times and sizes."""
    digits = {"ms": 1, "bytes": 0, "weights": 0, "gflop": 3}
    rows = [
        [f"`{method_of(name)}`", *(number(cost.get(key), places) for key, places in digits.items())]
        for name, cost in costs.items()
    ]
    return markdown(["", "ms", "bytes", "weights", "GFLOP"], rows)


def _equal_images(scores: Mapping[str, Scores], name: str) -> tuple[str, str] | None:
    """Weights of a run and of ours with nearly the same number of images, the last such pair."""
    theirs, ours = ([one for one in scores if one == run or one.startswith(f"{run}/")] for run in (name, OURS))
    pairs = [(images_of(scores[b]), images_of(scores[a]), a, b) for a in theirs for b in ours]
    pairs = [(fewer, a, b) for fewer, more, a, b in pairs if 0 < fewer <= more <= NEARLY * fewer]
    return max(pairs)[1:] if pairs else None


def _beside_ours(scores: Mapping[str, Scores], pairs: Sequence[tuple[str, str]]) -> tuple[str, str]:
    """Recall@1 of peers beside ours, and those that are ahead."""
    rows, ahead = [], []
    for name, ours in pairs:
        cells = [(mean(scores[name], column), mean(scores[ours], column)) for column in SIMULATED]
        better = [column.title for column, (a, b) in zip(SIMULATED, cells, strict=True) if a and b and a >= b + AHEAD]
        ahead += [f"`{name}` ({'all columns' if len(better) == len(cells) else '; '.join(better)})"] if better else []
        counts = (f"{images_of(scores[one]):,}" for one in (name, ours))
        rows.append([f"`{name}`", *counts, *(text(*pair) for pair in cells)])
    return markdown(["", "its images", f"images of `{OURS}`", *titles(SIMULATED)], rows), ", ".join(ahead) or "none"


def _baselines(scores: Mapping[str, Scores]) -> tuple[str, str]:
    """Each network beside its untrained self, and those that are not far above it."""
    rows, close = [], []
    for name in finals(scores):
        untrained, recall = scores.get(f"{method_of(name)}@random:0", {}), mean(scores[name], TOWN)
        if not images_of(scores[name]) or recall is None:
            continue
        baseline = mean(untrained, TOWN)
        close += [f"`{name}`"] if baseline is not None and recall < baseline + FAR else []
        directions = [Column("", (test,)) for test in (*TOWN.tests, *TRAINED_TOWN)]
        cells = (text(mean(scores[name], column), mean(untrained, column)) for column in directions)
        rows.append([f"`{name}`", text(recall), text(baseline), *cells])
    towns = ("same direction", "opposite direction", "training town, same", "training town, opposite")
    return markdown(["", "trained", "untrained", *towns], rows), ", ".join(close) or "none"


def _labels(scores: Mapping[str, Scores]) -> str:
    """What labels are worth."""
    rows = []
    for name, kind in LABELS.items():
        if name in scores:
            recalls = (text(mean(scores[name], column)) for column in LABELLED)
            rows.append([f"`{name.split(',')[0].split('/')[0]}`", kind, number(images_of(scores[name])), *recalls])
    return markdown(["", "labels", "images seen", *titles(LABELLED)], rows)


def _published_orders(scores: Mapping[str, Scores]) -> tuple[str, int]:
    """Published orders of two methods that are reversed here, and the number of pairs that differ."""
    published = {row.method: row for row in TABLE_1.rows}
    known = [(name, published[title]) for name, title in PUBLISHED_NAMES.items() if name in scores]
    pairs, rows = 0, []
    for (name, row), (other, against) in itertools.permutations(known, 2):
        score = "pairs" if row.f1max_protocol == "pairs-f1max" else "top1"
        here, there = mean(scores[name], TOWN, score), mean(scores[other], TOWN, score)
        if row.f1max_protocol != against.f1max_protocol or here is None or there is None:
            continue
        if row.mean >= against.mean + REVERSED:
            pairs += 1
            if here <= there - REVERSED:
                rows.append([f"{row.method}, {against.method}", text(row.mean, against.mean), text(here, there)])
    return markdown(["", "published", "here"], rows), pairs
