"""Evaluation across sessions: one session is the database, the others are queries, as in table 3 of the paper."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sglpr_jax.evaluation.inputs import read_descriptor_file
from sglpr_jax.evaluation.protocols import ALL, protocol_named, protocols_taking
from sglpr_jax.evaluation.protocols.source import positions_of
from sglpr_jax.evaluation.published import NCLT_DATABASE, TABLE_3
from sglpr_jax.evaluation.report import format_score
from sglpr_jax.evaluation.scoring import Evaluation
from sglpr_jax.files import naming, printable
from sglpr_jax.retrieval.descriptor_file import DescriptorFile, check_same_method

APART_M = 25.0
"""Largest distance, in metres, at which a protocol across sessions considers two frames the same place."""


def evaluate_sessions(
    database: Path, queries: Sequence[Path], names: Sequence[str] = (), *, published: bool = False
) -> Evaluation:
    """Score the retrieval of several query sessions in one database session.

    Arguments:
      database: Descriptor file of the database session.
      queries: Descriptor file of each query session.
      names: Names of the protocols. Without names, or with `all`, every protocol across sessions is used.
      published: Whether to add the rows of table 3 of the paper.

    Raises:
      ValueError: If a file has no positions, if a session occurs twice, does not overlap with the database or has
        descriptors of another method, or if a protocol is unknown.
    """
    for path in (database, *queries):
        if path.suffix != ".npz":
            raise ValueError(f"{path}: expected descriptor files of bin/embed (.npz) for an evaluation across sessions")
    there, *files = map(read_descriptor_file, (database, *queries))
    for path, file in zip(queries, files, strict=True):
        with naming(path):
            check_same_method(there, file)
    known = protocols_taking("sessions")
    chosen = list(dict.fromkeys(names)) if names and ALL not in names else list(known)
    protocols = [protocol_named(name, known) for name in chosen]
    sessions = [file.sequence for file in files]
    if len({there.sequence, *sessions}) <= len(sessions):
        found = f"database {there.sequence}, queries {', '.join(sessions)}"
        raise ValueError(f"expected different sessions, found {found}")
    for file in files:
        _check_one_world(there, file)
    width = there.descriptors.shape[1]
    return Evaluation(
        title=f"database {printable(there.sequence)}; queries of {len(sessions)} sessions",
        about=f"{database}: descriptors of {width} numbers, compared by {there.distance}",
        methods={file.sequence: [protocol(there, file) for protocol in protocols] for file in files},
        published=published_rows(there.sequence, sessions) if published else (),
        made_with={"files": [str(path) for path in queries], "database": str(database)},
        database=there.sequence,
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
