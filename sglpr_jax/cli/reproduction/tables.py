"""Tables 1 to 7 with our numbers beside the paper's, for the terminal, as JSON and as Markdown."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table

OURS, PUBLISHED = "here", "published"


@dataclass(frozen=True)
class Row:
    """One method: its score on each test drive by name (None: it has none there), measured here or published."""

    label: str
    source: str
    scores: Mapping[str, float | None]
    change: float | None = None
    """What the mean differs by from the one before the scans were turned (table 2's Cmp)."""

    def mean(self, columns: Sequence[str]) -> float | None:
        """The mean over the columns; None where one is missing, for it would be another mean."""
        values = [self.scores.get(name) for name in columns]
        return None if None in values or not values else sum(values) / len(values)  # type: ignore[arg-type]


def rich_table(title: str, rows: Sequence[Row], columns: Sequence[str], *, caption: str) -> Table:
    """Our rows and the paper's."""
    table = Table(title=title, caption=caption)
    for name in _head(rows, columns):
        table.add_column(name, justify="left" if name in ("method", "source") else "right")
    for row in rows:
        table.add_row(*_cells(row, rows, columns), style="dim" if row.source == PUBLISHED else None)
    return table


def markdown(title: str, rows: Sequence[Row], columns: Sequence[str], *, caption: str) -> str:
    """The same as Markdown."""
    head = _head(rows, columns)
    lines = [head, ["---"] * len(head), *(_cells(row, rows, columns) for row in rows)]
    return f"**{title}**\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines) + f"\n\n{caption}\n"


def as_json(rows: Sequence[Row], columns: Sequence[str]) -> list[dict[str, Any]]:
    """Plain values for `json.dump`."""
    return [
        {
            "method": row.label,
            "source": row.source,
            "scores": {name: row.scores.get(name) for name in columns},
            "mean": row.mean(columns),
            "change": row.change,
        }
        for row in rows
    ]


def score_or_none(score: float) -> float | None:
    """A protocol's score; None for the NaN of a drive without revisits."""
    return None if math.isnan(score) else score


def _head(rows: Sequence[Row], columns: Sequence[str]) -> list[str]:
    return ["method", "source", *columns, "mean", *(["change"] if _has_change(rows) else [])]


def _cells(row: Row, rows: Sequence[Row], columns: Sequence[str]) -> list[str]:
    cells = [row.label, row.source, *(_text(row.scores.get(name)) for name in columns), _text(row.mean(columns))]
    change = "" if row.change is None else f"{row.change:+.3f}"
    return [*cells, change] if _has_change(rows) else cells


def _has_change(rows: Sequence[Row]) -> bool:
    return any(row.change is not None for row in rows)


def _text(score: float | None) -> str:
    return "" if score is None else f"{score:.3f}"
