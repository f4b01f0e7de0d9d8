"""Tables and JSON of results of protocols (`Result`)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.files import printable
from sglpr_jax.metrics import PrecisionRecallCurve

WIDTH = 140
"""Width of printed results, in characters."""
MOST_IN_CELL = 300
"""Maximum number of characters of a line of a cell."""
MOST_COLUMNS = 6
"""Maximum number of protocols side by side. More do not fit a terminal."""
COLUMNS = ("protocol", "rule", "score", "95 %", "rests on", "distance", "poses")
"""Columns of a table of results. Counts are in "rests on", the dimensions of distances in "distance"."""
PRECISIONS = (0.99, 1.0)
"""Precisions for which results state a threshold."""
COORDINATES = ("distance", "precision", "recall")
"""Keys of a point of a precision-recall curve (`_point`), in the order of tables."""


class PrintsItself:
    """Base class of results that rich renders in `print`. Subclasses define `__rich__` or `__rich_console__`."""

    def __str__(self) -> str:
        console = Console(width=WIDTH, highlight=False, color_system=None)
        with console.capture() as capture:
            console.print(self)
        return capture.get()

    __repr__ = __str__


@dataclass(frozen=True)
class TextTable:
    """Table of plain text. The terminal shows control characters escaped and very long lines shortened."""

    kind: ClassVar = "table"
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: Sequence[str] = ()
    """Names of the columns with numbers, which are right-aligned."""
    title: str = ""
    caption: str = ""

    def __rich__(self) -> Table:
        table = Table(title=_plain(self.title, style="table.title"), caption=self.caption or None)
        for name in self.header:
            table.add_column(_plain(name), justify="right" if name in self.numbers else "left")
        for row in self.rows:
            table.add_row(*map(_plain, row))
        return table


def _plain(text: str, *, style: str = "") -> Text:
    """Return text that rich prints unchanged. From a str, rich would interpret names in brackets as styles."""
    return Text("\n".join(printable(line, most=MOST_IN_CELL) for line in text.split("\n")), style=style)


def results_table(results: Sequence[Result], *, title: str = "", published_on: bool = False) -> TextTable:
    """Return a table with a row for each result, and with `published_on` the poses of the published numbers."""
    rows = [
        (
            result.name,
            result.rule,
            format_score(result.score),
            "" if result.interval is None else "{:.3f} to {:.3f}".format(*result.interval),
            "\n".join(f"{count} {name}" for name, count in result.counts.items()),
            "as given" if result.dimensions is None else f"{result.dimensions}-D",
            result.pose_source or "",
            *([result.published_on] if published_on else []),
        )
        for result in results
    ]
    header = (*COLUMNS, "published on") if published_on else COLUMNS
    return TextTable(header, rows, ("score", "95 %", "rests on"), title)


def threshold_table(results: Sequence[Result]) -> TextTable:
    """Return a table with the descriptor distance of each curve at the highest F1 and at `PRECISIONS`."""
    header = ("protocol", "threshold for", "descriptor distance", "precision", "recall")
    rows = []
    for result in results:
        curve = result.curve
        if curve is None:
            continue
        points = {"highest F1": _point(curve, curve.best), **_at_precisions(curve, "precision {:g}")}
        for goal, point in points.items():
            cells = ["", "", ""] if point is None else [f"{point[name]:.3f}" for name in COORDINATES]
            rows.append((result.name, goal, *cells))
    return TextTable(header, rows, header[2:])


def comparison(methods: Mapping[str, Sequence[Result]], *, title: str = "") -> TextTable:
    """Return a table of scores, with a row for each method. More than `MOST_COLUMNS` protocols are rows instead."""
    first_results = next(iter(methods.values()))
    header = ("method", *(result.name for result in first_results))
    rows = [(name, *(format_score(result.score) for result in results)) for name, results in methods.items()]
    if len(first_results) > MOST_COLUMNS:
        _, *rows = zip(header, *rows, strict=True)  # transposed
        header = ("protocol", *methods)
    return TextTable(header, rows, header[1:], title)


def mean_score(results: Sequence[Result]) -> float:
    """Return the mean score over the sessions with a revisit, or NaN if no session has one."""
    scores = [result.score for result in results if not math.isnan(result.score)]
    return float(np.mean(scores)) if scores else math.nan


def format_score(score: float) -> str:
    """Return the score with three decimals, or "no revisit" if it is NaN."""
    return "no revisit" if math.isnan(score) else f"{score:.3f}"


def to_json(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return values for `json.dump`, a dictionary for each result. The score is null without a revisit."""
    return [
        {
            "protocol": result.name,
            "rule": result.rule,
            "score": score_or_none(result.score),
            "interval": result.interval,
            "counts": result.counts,
            "dimensions": result.dimensions,
            "poses": result.pose_source,
            "published_on": result.published_on,
            "average_precision": result.curve and result.curve.average_precision,
            "at_f1max": result.curve and _point(result.curve, result.curve.best),
            "at_precision": {} if result.curve is None else _at_precisions(result.curve, "{:g}"),
            "recall_at": result.recalls,
        }
        for result in results
    ]


def score_or_none(score: float) -> float | None:
    """Return the score, or None for a recording without revisits."""
    return None if math.isnan(score) else score


def _at_precisions(curve: PrecisionRecallCurve, key: str) -> dict[str, dict[str, float] | None]:
    """Return the point of the curve for each of `PRECISIONS` (None if not reached). `key` is the format of the keys."""
    return {key.format(precision): _point(curve, curve.at_precision(precision)) for precision in PRECISIONS}


def _point(curve: PrecisionRecallCurve, index: int | None) -> dict[str, float] | None:
    """Return precision, recall and largest accepted descriptor distance at the threshold with this index."""
    if index is None:
        return None
    return {
        "precision": float(curve.precision[index]),
        "recall": float(curve.recall[index]),
        "distance": float(-curve.thresholds[index]),  # thresholds are negated distances
    }
