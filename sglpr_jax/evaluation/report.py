"""Results as tables and as JSON."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sglpr_jax.evaluation.protocols import Result
from sglpr_jax.evaluation.published import LEARNED, TABLE_1

WIDTH = 140
"""Characters of a line, where results are made into text."""
MOST_COLUMNS = 6
"""More protocols side by side would not fit a terminal."""
COLUMNS = ("protocol", "rule", "score", "95 %", "rests on", "distance", "poses")
PUBLISHED_COLUMNS = ("method", "published F1max", "numbers from")
PUBLISHED_NOTE = (
    f"Published: learned methods in table 1 of the SG-LPR paper, on {TABLE_1.dataset}. The rows do not share one "
    "protocol: those of RINet's paper are pairs-f1max, the others top1-f1max as far as is known."
)


def table(results: Sequence[Result], *, title: str = "") -> Table:
    """Return one row per protocol: what it is, its score, and what that rests on."""
    rows = Table(*COLUMNS, title=title)
    for result in results:
        rows.add_row(*map(escape, cells(result)))
    return rows


def cells(result: Result) -> tuple[str, ...]:
    """Return what a table says of a result, one text for each of `COLUMNS`."""
    counts = "\n".join(f"{count} {name}" for name, count in result.counts.items())
    distance = "as given" if result.dimensions is None else f"{result.dimensions}-D"
    poses = result.pose_source or ""
    return result.name, result.rule, format_score(result), _format_interval(result), counts, distance, poses


def comparison(methods: Mapping[str, Sequence[Result]], *, title: str = "") -> Table:
    """Return one row per method and one column per protocol; the other way round where that would be too wide.

    The methods are scored on the same sequence.
    """
    names = [result.name for result in next(iter(methods.values()))]
    scores = [[format_score(result) for result in results] for results in methods.values()]
    if len(names) <= MOST_COLUMNS:
        rows = Table("method", *names, title=title)
        lines = zip(methods, scores, strict=True)
    else:
        rows = Table("protocol", *methods, title=title)
        lines = zip(names, zip(*scores, strict=True), strict=True)
    for name, line in lines:
        rows.add_row(escape(name), *line)
    return rows


def published_rows(sequence: str) -> list[tuple[str, ...]]:
    """Return what table 1 of the paper has for a KITTI sequence, of the learned methods; ValueError where nothing."""
    if sequence not in TABLE_1.columns:
        raise ValueError(f"expected a sequence with published numbers, {', '.join(TABLE_1.columns)}, found {sequence}")
    sources = {row.method: row.source for row in TABLE_1.rows}
    scores = TABLE_1.column(sequence, kind=LEARNED)
    return [(method, f"{score:.3f}", sources[method]) for method, score in scores.items()]


def published_table(rows: Sequence[tuple[str, ...]]) -> Table:
    """Return `published_rows` as a table of its own; `PUBLISHED_NOTE` belongs below it."""
    table = Table(*PUBLISHED_COLUMNS)
    for row in rows:
        table.add_row(*row)
    return table


def as_text(found: Any, *, width: int) -> str:
    """Return what a console of so many columns would show."""
    console = Console(width=width, highlight=False, color_system=None)
    with console.capture() as capture:
        console.print(found)
    return capture.get()


class PrintsItself:
    """A result that `print` shows as a console does: derive from it, and give `__rich__` or `__rich_console__`."""

    def __str__(self) -> str:
        return as_text(self, width=WIDTH)

    __repr__ = __str__


def format_score(result: Result) -> str:
    """Return the score to three places, or why there is none."""
    return "no revisit" if math.isnan(result.score) else f"{result.score:.3f}"


def _format_interval(result: Result) -> str:
    """Return the bootstrap interval of the score to three places; empty where there is none."""
    return "" if result.interval is None else "{:.3f} to {:.3f}".format(*result.interval)


def to_json(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return plain values for `json.dump`: the score (null: no revisit), its interval, rule, counts, curve in short."""
    return [
        {
            "protocol": result.name,
            "rule": result.rule,
            "score": None if math.isnan(result.score) else result.score,
            "interval": None if result.interval is None else list(result.interval),
            "counts": result.counts,
            "dimensions": result.dimensions,
            "poses": result.pose_source,
            "published_on": result.published_on,
            "average_precision": None if result.curve is None else result.curve.average_precision,
            "at_f1max": _at_f1max(result),
            "recall_at": {str(n): recall for n, recall in result.recalls.items()},
        }
        for result in results
    ]


def _at_f1max(result: Result) -> dict[str, float] | None:
    """Return precision, recall and the largest descriptor distance accepted, where F1 is highest."""
    curve = result.curve
    if curve is None:
        return None
    return {
        "precision": float(curve.precision[curve.best]),
        "recall": float(curve.recall[curve.best]),
        "distance": float(-curve.thresholds[curve.best]),
    }
