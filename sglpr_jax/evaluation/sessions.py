"""Evaluation across sessions: one session is the database, the others are queries, as in table 3 of the paper."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console, ConsoleOptions

from sglpr_jax.evaluation.inputs import read_descriptor_file
from sglpr_jax.evaluation.protocols import ALL, protocol_named, protocols_taking
from sglpr_jax.evaluation.protocols.protocol import Result
from sglpr_jax.evaluation.protocols.source import positions_of
from sglpr_jax.evaluation.published import NCLT_DATABASE, TABLE_3
from sglpr_jax.evaluation.report import PrintsItself, TextTable, format_score, results_table, to_json
from sglpr_jax.files import naming, printable
from sglpr_jax.retrieval.descriptor_file import DescriptorFile, check_same_method

APART_M = 25.0
"""Largest distance, in metres, at which a protocol across sessions considers two frames the same place."""
PUBLISHED_NOTE = f"Published: table 3 of the SG-LPR paper, on {TABLE_3.dataset}, by bevplace-nclt-recall's rule."


@dataclass(frozen=True, eq=False, repr=False)
class AcrossSessions(PrintsItself):
    """Results of one method for several query sessions, searched in one database. Prints itself as tables."""

    database: str
    """Name of the database session."""
    sessions: tuple[str, ...]
    """Names of the query sessions."""
    protocols: Mapping[str, Sequence[Result]]
    """Results by protocol name, one for each query session."""
    about: str = ""
    """Description of the input and its distance, in one line."""
    published: Sequence[tuple[str, ...]] = ()
    """`published_rows`, if requested."""
    made_with: Mapping[str, Any] = field(default_factory=dict)
    """Paths of the files, as JSON values."""

    @property
    def title(self) -> str:
        """Title of the tables."""
        return f"database {printable(self.database)}; queries of {len(self.sessions)} sessions"

    @property
    def results(self) -> list[Result]:
        """Results of all protocols and sessions, in order of protocol."""
        return [result for of_one in self.protocols.values() for result in of_one]

    def table(self) -> TextTable:
        """Return a table with the score of each session and their mean, in a row for each protocol.

        The published rows follow.
        """
        header = ("", *map(printable, self.sessions), "mean")
        rows = [
            (name, *(format_score(result.score) for result in results), format_score(mean_score(results)))
            for name, results in self.protocols.items()
        ]
        return TextTable(header, [*rows, *self.published], header[1:], self.title)

    def to_json(self) -> dict[str, Any]:
        """Return values for `json.dump`."""
        results = {
            name: {
                "mean": None if math.isnan(mean_score(of_one)) else mean_score(of_one),
                "sessions": dict(zip(self.sessions, to_json(of_one), strict=True)),
            }
            for name, of_one in self.protocols.items()
        }
        published = {"about": PUBLISHED_NOTE, "columns": self.table().header, "rows": self.published}
        beside = {"published": published} if self.published else {}
        return {**self.made_with, "database_session": self.database, "results": results, **beside}

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[TextTable | str]:
        yield results_table(self.results)
        yield self.table()
        if self.published:
            yield PUBLISHED_NOTE


def mean_score(results: Sequence[Result]) -> float:
    """Return the mean score over the sessions with a revisit, or NaN if no session has one."""
    scores = [result.score for result in results if not math.isnan(result.score)]
    return float(np.mean(scores)) if scores else math.nan


def evaluate_session_files(
    database: Path, queries: Sequence[Path], names: Sequence[str] = (), *, published: bool = False
) -> AcrossSessions:
    """Run `evaluate_sessions` on paths of descriptor files. Raises ValueError for other kinds of files, too."""
    files = []
    for path in (database, *queries):
        if path.suffix != ".npz":
            raise ValueError(f"{path}: expected descriptor files of bin/embed (.npz) for an evaluation across sessions")
        files.append(read_descriptor_file(path))
    for path, file in zip(queries, files[1:], strict=True):
        with naming(path):
            check_same_method(files[0], file)
    found = evaluate_sessions(files[0], files[1:], names, published=published)
    made_with = {"files": [str(path) for path in queries], "database": str(database)}
    return replace(found, about=f"{database}: {found.about}", made_with=made_with)


def evaluate_sessions(
    database: DescriptorFile, queries: Sequence[DescriptorFile], names: Sequence[str] = (), *, published: bool = False
) -> AcrossSessions:
    """Score the retrieval of several query sessions in one database session.

    Arguments:
      database: Descriptors of the database session.
      queries: Descriptors of each query session.
      names: Names of the protocols. Without names, or with `all`, every protocol across sessions is used.
      published: Whether to add the rows of table 3 of the paper.

    Raises:
      ValueError: If a session occurs twice, has no positions, does not overlap with the database or has descriptors
        of another method, or if a protocol is unknown.
    """
    known = protocols_taking("sessions")
    chosen = list(dict.fromkeys(names)) if names and ALL not in names else list(known)
    protocols = {name: protocol_named(name, known) for name in chosen}
    sessions = tuple(file.sequence for file in queries)
    if len({database.sequence, *sessions}) <= len(sessions):
        found = f"database {database.sequence}, queries {', '.join(sessions)}"
        raise ValueError(f"expected different sessions, found {found}")
    for file in queries:
        _check_one_world(database, file)
    return AcrossSessions(
        database.sequence,
        sessions,
        {name: [protocol(database, file) for file in queries] for name, protocol in protocols.items()},
        about=f"descriptors of {database.descriptors.shape[1]} numbers, compared by {database.distance}",
        published=published_rows(database.sequence, sessions) if published else (),
    )


def published_rows(database: str, sessions: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the rows of table 3 for these sessions, marked as published.

    Cells of sessions that are not in the table are empty and do not count in the mean. Raises ValueError if the
    database is not that of the table, or if the table has none of the sessions.
    """
    shown = [session for session in sessions if session in TABLE_3.columns]
    if database != NCLT_DATABASE or not shown:
        raise ValueError(
            f"expected database {NCLT_DATABASE} and queries among {', '.join(TABLE_3.columns)}, for which numbers "
            f"are published; found database {database} and queries {', '.join(sessions)}"
        )
    rows = []
    for row in TABLE_3.rows:
        scores = dict(zip(TABLE_3.columns, row.scores, strict=True))
        mean = row.mean if len(shown) == len(scores) else float(np.mean([scores[session] for session in shown]))
        cells = (format_score(scores[session]) if session in scores else "" for session in sessions)
        rows.append((f"published: {row.method}", *cells, format_score(mean)))
    return rows


def _check_one_world(database: DescriptorFile, queries: DescriptorFile) -> None:
    """Raise ValueError if the areas of the two sessions do not overlap. Their positions then have different frames."""
    planes = [positions_of(file, 2) for file in (database, queries)]
    (low, high), (low_q, high_q) = ((places.min(axis=0), places.max(axis=0)) for places in planes)
    if np.any(low_q > high + APART_M) or np.any(high_q < low - APART_M):
        there, here = (
            f"x {a[0]:.0f} to {b[0]:.0f}, y {a[1]:.0f} to {b[1]:.0f} m" for a, b in ((low, high), (low_q, high_q))
        )
        raise ValueError(
            f"expected {queries.sequence} in the world frame of the database {database.sequence} ({there}), found it "
            f"elsewhere ({here}): no place is in both"
        )
