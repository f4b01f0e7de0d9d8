"""Tables of the scores of several methods on a clean recording and under corruptions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sglpr_jax.evaluation.plain_table import PlainTable
from sglpr_jax.evaluation.protocols.protocol import Result
from sglpr_jax.evaluation.report import PrintsItself, format_score, to_json


@dataclass(frozen=True, eq=False)
class StressRow:
    """Scores of the methods under one corruption. The first row of a test is the clean recording."""

    name: str
    kind: str
    label: str
    """Strength of the corruption, with its unit."""
    results: Mapping[str, Sequence[Result]]
    """Results by method, one for each protocol. Every row has the same methods and protocols."""


@dataclass(frozen=True, eq=False, repr=False)
class StressTest(PrintsItself):
    """Scores of several methods on a clean recording and under corruptions. Prints itself as a table."""

    title: str
    rows: Sequence[StressRow]
    config: Mapping[str, Any]
    """Configuration of the test, as JSON values."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Reasons why corruptions were skipped, by the name of the corruption."""

    def to_json(self) -> list[dict[str, Any]]:
        """Return values for `json.dump`, one item per row."""
        return stress_json(self.rows)

    def __rich__(self) -> PlainTable:
        return stress_table(self.rows, title=self.title)


def score_changes(row: StressRow, clean: StressRow) -> dict[str, list[float]]:
    """Return the change of each score relative to the clean recording, by method. NaN without a revisit."""
    return {
        method: [there.score - here.score for there, here in zip(results, clean.results[method], strict=True)]
        for method, results in row.results.items()
    }


def stress_table(rows: Sequence[StressRow], *, title: str = "") -> PlainTable:
    """Return a table with one row per corruption and one column per method and protocol.

    Each cell has the score and its change relative to the clean recording.
    """
    table = PlainTable("corruption", title=title)
    for method, results in rows[0].results.items():
        for result in results:
            table.add_column(f"{method}\n{result.name}", justify="right")
    for row in rows:
        changes = score_changes(row, rows[0])
        cells = [
            format_score(result) if row is rows[0] or np.isnan(change) else f"{format_score(result)} {_signed(change)}"
            for method, results in row.results.items()
            for result, change in zip(results, changes[method], strict=True)
        ]
        table.add_row(row.name, *cells)
    return table


def _signed(change: float) -> str:
    return f"{round(change, 3) + 0.0:+.3f}"  # + 0.0 turns -0.0 into 0.0


def stress_json(rows: Sequence[StressRow]) -> list[dict[str, Any]]:
    """Return values for `json.dump`: the results of each row, each with its `change` (null without a revisit)."""
    return [
        {
            "corruption": row.name,
            "methods": {
                method: [
                    {**result, "change": None if np.isnan(change) else change}
                    for result, change in zip(to_json(row.results[method]), changes, strict=True)
                ]
                for method, changes in score_changes(row, rows[0]).items()
            },
        }
        for row in rows
    ]


def changes_by_kind(rows: Sequence[StressRow]) -> dict[tuple[str, str], dict[str, list[tuple[str, float]]]]:
    """Return the input of `figures.stress`: labels and changes by (protocol, kind of corruption) and by method."""
    found: dict[tuple[str, str], dict[str, list[tuple[str, float]]]] = {}
    for row in rows[1:]:
        for method, changes in score_changes(row, rows[0]).items():
            for result, change in zip(row.results[method], changes, strict=True):
                panel = found.setdefault((result.name, row.kind), {})
                panel.setdefault(method, []).append((row.label, change))
    return found
