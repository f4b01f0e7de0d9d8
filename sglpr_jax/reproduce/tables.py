"""Tables 1 to 7 with the reproduced and the published numbers, for the terminal, as JSON and as Markdown."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sglpr_jax.evaluation.plain_table import PlainTable
from sglpr_jax.evaluation.report import PrintsItself

OURS, PUBLISHED = "here", "published"
NONE, NO_REVISITS = "-", "no revisits"
"""Text of a cell without a number, and of a missing score of a reproduced row."""


@dataclass(frozen=True)
class Row:
    """Scores of one method by test recording (None: no score), reproduced here or published."""

    label: str
    source: str
    scores: Mapping[str, float | None]
    change: float | None = None
    """Change of the mean when the scans are rotated (table 2's Cmp)."""

    def mean(self, columns: Sequence[str]) -> float | None:
        """Return the mean over the columns. If a column is missing, return None, because the mean would not be
        comparable."""
        values = [self.scores.get(name) for name in columns]
        return None if None in values or not values else sum(values) / len(values)  # type: ignore[arg-type]


@dataclass(frozen=True, repr=False)
class PaperTable(PrintsItself):
    """A table of the paper: the reproduced rows, then the published ones. It can be printed."""

    title: str
    rows: Sequence[Row]
    columns: Sequence[str]
    caption: str

    def __rich__(self) -> PlainTable:
        table = PlainTable(title=self.title, caption=self.caption)
        for name in self._head():
            table.add_column(name, justify="left" if name in ("method", "source") else "right")
        for row in self.rows:
            table.add_row(*self._cells(row), style="dim" if row.source == PUBLISHED else None)
        return table

    def markdown(self) -> str:
        """Return the table as Markdown."""
        head = self._head()
        lines = [head, ["---"] * len(head), *map(self._cells, self.rows)]
        table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
        return f"**{self.title}**\n\n{table}\n\n{self.caption}\n"

    def to_json(self) -> list[dict[str, Any]]:
        """Return plain values for `json.dump`."""
        return [
            {
                "method": row.label,
                "source": row.source,
                "scores": {name: row.scores.get(name) for name in self.columns},
                "mean": row.mean(self.columns),
                "change": row.change,
            }
            for row in self.rows
        ]

    @property
    def _has_change(self) -> bool:
        return any(row.change is not None for row in self.rows)

    def _head(self) -> list[str]:
        return ["method", "source", *self.columns, "mean", *(["change"] if self._has_change else [])]

    def _cells(self, row: Row) -> list[str]:
        missing = NO_REVISITS if row.source == OURS else NONE
        scores = (_text(row.scores.get(name), missing) for name in self.columns)
        change = NONE if row.change is None else f"{row.change:+.3f}"
        return [row.label, row.source, *scores, _text(row.mean(self.columns)), *([change] if self._has_change else [])]


def score_or_none(score: float) -> float | None:
    """Return a protocol's score, or None for NaN, the score of a recording without revisits."""
    return None if math.isnan(score) else score


def _text(score: float | None, missing: str = NONE) -> str:
    return missing if score is None else f"{score:.3f}"
