"""Columns and cells of the tables of the leaderboard."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

Scores = Mapping[str, Mapping[str, Any]]
"""Results of one contender, by test recording."""


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
DAY = Column("another day", ("days-604",))
SIMULATED = (TOWN, TOWN.rotated, SCENERIES, SENSORS, DAY)
LABELLED = SIMULATED[:-1]
"""The recordings of two days have no labels."""
SEQS = tuple(Column(seq, (f"kitti-{seq}",)) for seq in ("00", "02", "06"))
KITTI = Column("KITTI", tuple(test for column in SEQS for test in column.tests))


def method_of(name: str) -> str:
    """Return the method of a contender: `rinet` of `rinet-0/weights-1000` and of `rinet@random:0`."""
    return re.sub(r"-\d$", "", name.split("/")[0].split("@")[0])


def finals(scores: Mapping[str, Scores]) -> list[str]:
    """Return the contenders, without the weights along a training and those with other labels."""
    return [name for name in scores if "/" not in name and "," not in name]


def images_of(found: Scores) -> int:
    """Return the number of images that a contender was trained with."""
    return next(iter(found.values()))["images"] or 0


def mean(found: Scores, column: Column, score: str) -> float | None:
    """Return the mean of a score over recordings, or None if one is missing."""
    values = [found[test]["scores"].get(score) if test in found else None for test in column.tests]
    return None if None in values else sum(values) / len(values)  # type: ignore[arg-type]


def three(found: Scores, column: Column) -> str:
    """Return top-1 F1max, pairs F1max and Recall@1."""
    return joined(mean(found, column, score) for score in ("top1", "pairs", "recall"))


def joined(values: Iterable[float | None]) -> str:
    """Return a cell of several values, or of none."""
    texts = [text(value) for value in values]
    return "-" if set(texts) == {"-"} else ", ".join(texts)


def both(a: float | None, b: float | None) -> str:
    """Return a cell of two values to compare."""
    return f"{text(a)} / {text(b)}"


def text(value: float | None) -> str:
    """Return a score as a cell."""
    return "-" if value is None else f"{value:.3f}"


def number(value: float | None, digits: int = 0) -> str:
    """Return a number as a cell."""
    return "-" if value is None else f"{value:,.{digits}f}"


def section(about: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a text and its table, or nothing if the table has no rows."""
    if not rows:
        return ""
    table = "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))
    return f"{about}\n{table}\n"
