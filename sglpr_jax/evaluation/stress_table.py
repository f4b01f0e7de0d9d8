"""Methods on a clean recording and on corrupted ones by the same protocols, side by side."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from rich.table import Table

from sglpr_jax.evaluation.protocols import Result
from sglpr_jax.evaluation.report import PrintsItself, format_score, to_json


@dataclass(frozen=True, eq=False)
class StressRow:
    """What the methods score under one corruption. Of several rows the first is the clean recording."""

    name: str
    kind: str
    label: str
    """The strength, with its unit."""
    results: Mapping[str, Sequence[Result]]
    """By method, one for each protocol: the same methods and protocols in every row."""


@dataclass(frozen=True, eq=False, repr=False)
class StressTest(PrintsItself):
    """What several methods score on a recording as it is and under corruptions. Prints itself as a table."""

    title: str
    rows: Sequence[StressRow]
    config: Mapping[str, Any]
    """What was tested, as JSON can hold it."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Why which corruptions were left out, by their names."""

    def to_json(self) -> list[dict[str, Any]]:
        """Return plain values for `json.dump`, a row each."""
        return stress_json(self.rows)

    def __rich__(self) -> Table:
        return stress_table(self.rows, title=self.title)


def score_changes(row: StressRow, clean: StressRow) -> dict[str, list[float]]:
    """Return by method the change of every protocol's score against the clean recording; NaN without a revisit."""
    return {
        method: [there.score - here.score for there, here in zip(results, clean.results[method], strict=True)]
        for method, results in row.results.items()
    }


def stress_table(rows: Sequence[StressRow], *, title: str = "") -> Table:
    """Return one row per corruption, one column per method and protocol: the score, and its change against clean."""
    table = Table("corruption", title=title)
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
    return f"{round(change, 3) + 0.0:+.3f}"  # + 0.0: a loss that rounds to none is no minus zero


def stress_json(rows: Sequence[StressRow]) -> list[dict[str, Any]]:
    """Return plain values for `json.dump`: of every row the results, each with its `change` (null: no revisit)."""
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
    """Return what `figures.stress` draws: by protocol and kind of corruption, by method, labels and changes."""
    found: dict[tuple[str, str], dict[str, list[tuple[str, float]]]] = {}
    for row in rows[1:]:
        for method, changes in score_changes(row, rows[0]).items():
            for result, change in zip(row.results[method], changes, strict=True):
                panel = found.setdefault((result.name, row.kind), {})
                panel.setdefault(method, []).append((row.label, change))
    return found
