"""Numbers of the SG-LPR paper: tables 1 to 7, row by row as printed.

The rows of a table do not share one protocol. The paper names the source of each row. From the source we infer the
protocol (docs/concepts/protocols.md):

- "RINet's paper": `pairs-f1max`, F1max over pairs with 100 negatives per positive.
- "its own paper": `top1-f1max`, top-1 F1max with 3 m, 20 m and 30 s.
- "no source named": not known.
- "run by SG-LPR's authors": not stated; most likely `top1-f1max`.
- "BEVPlace++'s paper": `bevplace-nclt-recall`, Recall@1 across sessions of NCLT with 5 m.

In tables 1 and 2 the printed mean of SC_LPR is 0.850, but the mean of its row is 0.853. All other means agree within
rounding.

Our numbers are comparable with these only under the same protocol, on the same poses and on the real dataset.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from statistics import fmean
from typing import Any, Literal

RINET = "RINet's paper"

NCLT_DATABASE = "2012-01-15"
"""Database session of table 3."""


@dataclass(frozen=True)
class Row:
    """Scores of one method or variant, in the order of the columns of its table."""

    method: str
    scores: tuple[float, ...]
    mean: float
    """Mean as printed. It may differ from the mean of the rounded scores."""
    kind: Literal["handcrafted", "learned"]
    source: str
    """Source of the numbers according to the paper. It determines the protocol."""

    @property
    def f1max_protocol(self) -> str:
        """Name of the protocol of an F1max, in tables 1 and 2."""
        return "pairs-f1max" if self.source == RINET else "top1-f1max"


@dataclass(frozen=True)
class Table:
    """One table of the paper. The columns are sequences."""

    number: int
    dataset: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]


def _read(table: dict[str, Any]) -> Table:
    """Return a table of `published.json`, whose rows are lists of method, kind, source, scores and printed mean."""
    rows = tuple(Row(method, tuple(scores), mean, kind, source) for method, kind, source, scores, mean in table["rows"])
    return Table(table["number"], table["dataset"], tuple(table["columns"]), rows)


TABLES = tuple(map(_read, json.loads((resources.files("sglpr_jax.evaluation") / "published.json").read_text())))
TABLE_1, TABLE_2, TABLE_3, *_ = TABLES
TABLE_1_NOTE = (
    f"Published: learned methods in table 1 of the SG-LPR paper, on {TABLE_1.dataset}. The rows do not share one "
    "protocol: rows from RINet's paper use pairs-f1max, the others top1-f1max as far as is known."
)
TABLE_3_NOTE = f"Published: table 3 of the SG-LPR paper, on {TABLE_3.dataset}, by bevplace-nclt-recall's rule."


def table_1_rows(sequence: str) -> list[tuple[str, ...]]:
    """Return method, score and source of the learned methods in table 1. Raises ValueError for another sequence."""
    if sequence not in TABLE_1.columns:
        raise ValueError(f"expected a sequence with published numbers, {', '.join(TABLE_1.columns)}, found {sequence}")
    column = TABLE_1.columns.index(sequence)
    return [(row.method, f"{row.scores[column]:.3f}", row.source) for row in TABLE_1.rows if row.kind == "learned"]


def table_3_rows(database: str, sessions: Sequence[str]) -> list[tuple[str, ...]]:
    """Return rows of table 3 for these query sessions: "published: METHOD", the scores and their mean.

    Cells of sessions that are not in the table are empty and do not count in the mean. Raises ValueError if the
    database is not that of the table, or if the table has none of the sessions.
    """
    sessions_in_table = [session for session in sessions if session in TABLE_3.columns]
    if database != NCLT_DATABASE or not sessions_in_table:
        raise ValueError(
            f"expected database {NCLT_DATABASE} and queries among {', '.join(TABLE_3.columns)}, for which numbers "
            f"are published; found database {database} and queries {', '.join(sessions)}"
        )
    rows = []
    for row in TABLE_3.rows:
        scores = dict(zip(TABLE_3.columns, row.scores, strict=True))
        mean = fmean(scores[session] for session in sessions_in_table)
        if len(sessions_in_table) == len(scores):
            mean = row.mean  # as printed, which may differ from the mean of the rounded scores
        cells = (f"{scores[session]:.3f}" if session in scores else "" for session in sessions)
        rows.append((f"published: {row.method}", *cells, f"{mean:.3f}"))
    return rows
