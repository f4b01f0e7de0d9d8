"""Tables of the leaderboard: Recall@1 of all contenders beside their costs, and beside published numbers."""

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

Scores = Mapping[str, Mapping[str, Any]]
"""Results of one contender, by test recording."""
PUBLISHED_RECALL = {
    "BEVPlace": (0.997, 0.981, 1.000),
    "BEVPlace++": (0.999, 0.994, 1.000),
    "ResNet-34 + NetVLAD": (0.963, 0.841, 0.985),
    "OverlapTransformer": (0.967, 0.801, 0.956),
    "PointNetVLAD": (0.916, 0.623, 0.778),
}
"""Recall@1 on 00, 02 and 06 as published in the papers of BEVPlace and BEVPlace++."""


class Column(NamedTuple):
    """A mean over test recordings."""

    title: str
    tests: tuple[str, ...]


TOWN = Column("town", ("town-601-00", "town-601-08"))
KITTI = tuple(Column(f"KITTI {seq}", (f"kitti-{seq}",)) for seq in ("00", "02", "06"))
COLUMNS = (
    TOWN,
    Column("rotated", tuple(f"{test}-rotated" for test in TOWN.tests)),
    Column("other sceneries", ("outskirts-602-08", "lanes-602-08", "car_park-602-08")),
    Column("other sensors", ("vlp16-603-08", "os1-64-603-08")),
    Column("unseen sensor", ("xt32-603-08",)),
    Column("other sensor's map", ("os1-64-603-08-in-vlp16-603-08", "xt32-603-08-in-vlp16-603-08")),
    Column("other lane", ("aside-3-601-00-in-town-601-00", "aside-3-601-08-in-town-601-08")),
    Column("another day", ("days-604",)),
    Column("walks", ("campus-605-08", "yard-605-08")),
    *KITTI,
)


class Row(NamedTuple):
    """Contenders that differ in their seeds only."""

    method: str
    kind: str
    """Trained or untrained, and the labels; empty for shipped weights and handcrafted methods."""
    results: Sequence[Scores]

    @property
    def title(self) -> str:
        """The first cell of the row."""
        return f"`{self.method}`{', ' if self.kind else ''}{self.kind}"

    def means(self, column: Column, score: str = "recall") -> list[float]:
        """The mean of a score over the recordings of a column, of each contender that has all of them."""
        empty: Mapping[str, Any] = {"scores": {}}
        values = [[one.get(test, empty)["scores"].get(score) for test in column.tests] for one in self.results]
        return [sum(one) / len(one) for one in values if None not in one]

    def effort(self, name: str) -> float | None:
        """The mean of `images` or `seconds` of training."""
        values = [next(iter(one.values()))[name] for one in self.results]
        return None if None in values else sum(values) / len(values)


def method_of(name: str) -> str:
    """The method of a contender: `rinet` of `rinet-0` and of `rinet@random:0`."""
    return re.sub(r"-\d$", "", name.split("@")[0])


def rows(scores: Mapping[str, Scores]) -> list[Row]:
    """One row for each method and kind of weights. The highest Recall@1 in the town is first."""
    seeds: dict[tuple[str, str], list[Scores]] = {}
    for name, results in scores.items():
        contender, comma, labels = name.partition(",")
        method = method_of(contender)
        kind = "untrained" if "@" in contender else "trained" if method != contender else ""
        seeds.setdefault((method, f"{kind}{comma}{labels}"), []).append(results)
    by_seed = (Row(*names, results) for names, results in seeds.items())
    return sorted(by_seed, key=lambda row: -sum(row.means(TOWN)) / len(row.results))


def tables(results: Mapping[str, Any]) -> dict[str, str]:
    """Values of the page's template."""
    by_recall = rows(results["scores"])
    costs = {method_of(name): cost for name, cost in results["costs"].items()}
    return {"recalls": _recalls(by_recall, costs), "published": _published(by_recall)}


def _recalls(by_recall: Sequence[Row], costs: Mapping[str, Any]) -> str:
    """Recall@1 on all recordings beside what it costs."""
    lines = []
    for row in by_recall:
        cost = costs.get(row.method, {})
        numbers = (_number(row.effort("images")), _number(row.effort("seconds")), _number(cost.get("ms"), 1))
        lines.append([row.title, *(_cell(row.means(one)) for one in COLUMNS), *numbers, _number(cost.get("bytes"))])
    more = ("images seen", "training (s)", "description (ms)", "descriptor (bytes)")
    return _markdown(["", *(column.title for column in COLUMNS), *more], lines)


def _published(by_recall: Sequence[Row]) -> str:
    """Recall@1 by the published split into map and queries."""
    ours = {row.title: [row.means(column, "split recall") for column in KITTI] for row in by_recall}
    published = {f"{name}, published": [[value] for value in values] for name, values in PUBLISHED_RECALL.items()}
    lines = [[name, *map(_cell, values)] for name, values in (ours | published).items() if any(values)]
    return _markdown(["", *(column.title for column in KITTI)], lines)


def _cell(values: Sequence[float]) -> str:
    """The mean over seeds, and half the difference between the highest and the lowest value."""
    if not values:
        return "-"
    spread = f" ± {(max(values) - min(values)) / 2:.3f}" if len(values) > 1 else ""
    return f"{sum(values) / len(values):.3f}{spread}"


def _number(value: float | None, digits: int = 0) -> str:
    return "-" if value is None else f"{value:,.{digits}f}"


def _markdown(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *lines))
