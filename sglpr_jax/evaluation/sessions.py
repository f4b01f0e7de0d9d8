"""One session as the map, others as queries: a column for each session and their mean, as in table 3 of the paper."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sglpr_jax.evaluation.inputs.choice import ALL
from sglpr_jax.evaluation.protocols import CROSS_SESSION_PROTOCOLS, Result, protocol_named
from sglpr_jax.evaluation.protocols.source import positions_of
from sglpr_jax.evaluation.published import NCLT_MAP, TABLE_3
from sglpr_jax.evaluation.report import format_score
from sglpr_jax.retrieval.descriptor_file import DescriptorFile

APART_M = 25.0
"""The largest distance at which a protocol here calls two frames one place."""


@dataclass(frozen=True, eq=False)
class AcrossSessions:
    """The results of one method, asked on every session about one map."""

    map_session: str
    sessions: tuple[str, ...]
    protocols: Mapping[str, Sequence[Result]]
    """By the protocol's name: one result for each session."""

    @property
    def columns(self) -> tuple[str, ...]:
        """What stands over `rows`."""
        return ("", *self.sessions, "mean")

    def rows(self) -> list[tuple[str, ...]]:
        """Return a row for each protocol: its name, the score of each session, the mean of those that have one."""
        return [
            (name, *map(format_score, results), _text(mean_score(results))) for name, results in self.protocols.items()
        ]

    def published_rows(self) -> list[tuple[str, ...]]:
        """Return the rows of table 3 in the same columns, marked as published; the mean is that of the columns shown.

        Sessions that the table does not have are left empty. Raises ValueError where it has none of them, or another
        map.
        """
        shown = [session for session in self.sessions if session in TABLE_3.columns]
        if self.map_session != NCLT_MAP or not shown:
            raise ValueError(
                f"expected map {NCLT_MAP} and queries among {', '.join(TABLE_3.columns)}, for which numbers are "
                f"published; found map {self.map_session} and queries {', '.join(self.sessions)}"
            )
        columns = [TABLE_3.column(session) for session in self.sessions]
        complete = len(shown) == len(TABLE_3.columns)
        rows = []
        for row in TABLE_3.rows:
            scores = [column.get(row.method) for column in columns]
            mean = row.mean if complete else float(np.mean([score for score in scores if score is not None]))
            rows.append((f"published: {row.method}", *map(_text, scores), _text(mean)))
        return rows


PUBLISHED_NOTE = f"Published: table 3 of the SG-LPR paper, on {TABLE_3.dataset}, by bevplace-nclt-recall's rule."


def evaluate_sessions(
    database: DescriptorFile, queries: Sequence[DescriptorFile], names: Sequence[str] = ()
) -> AcrossSessions:
    """Score every session of `queries` against the map by each named protocol; none or `all` named: by all of them.

    Raises ValueError where a session occurs twice, has no positions, lies elsewhere than the map or has other
    descriptors, and for an unknown protocol.
    """
    chosen = list(dict.fromkeys(names)) if names and ALL not in names else list(CROSS_SESSION_PROTOCOLS)
    protocols = {name: protocol_named(name, CROSS_SESSION_PROTOCOLS) for name in chosen}
    sessions = tuple(file.sequence for file in queries)
    if len({database.sequence, *sessions}) <= len(sessions):
        raise ValueError(f"expected different sessions, found map {database.sequence}, queries {', '.join(sessions)}")
    for file in queries:
        check_one_world(database, file)
    return AcrossSessions(
        database.sequence,
        sessions,
        {name: [protocol(database, file) for file in queries] for name, protocol in protocols.items()},
    )


def check_one_world(database: DescriptorFile, queries: DescriptorFile) -> None:
    """Raise ValueError where the two sessions do not overlap in x and y at all: their positions are in two frames."""
    corners = [(places.min(axis=0), places.max(axis=0)) for places in map(_plane, (database, queries))]
    (low, high), (low_q, high_q) = corners
    if np.any(low_q > high + APART_M) or np.any(high_q < low - APART_M):
        there, here = (f"x {a[0]:.0f} to {b[0]:.0f}, y {a[1]:.0f} to {b[1]:.0f} m" for a, b in corners)
        raise ValueError(
            f"expected {queries.sequence} in the world frame of the map {database.sequence} ({there}), found it "
            f"elsewhere ({here}): no place is in both"
        )


def mean_score(results: Sequence[Result]) -> float:
    """Return the mean over the sessions with something to find; NaN where none has."""
    scores = [result.score for result in results if not math.isnan(result.score)]
    return float(np.mean(scores)) if scores else math.nan


def _plane(file: DescriptorFile) -> np.ndarray:
    return positions_of(file, 2)


def _text(score: float | None) -> str:
    if score is None:
        return ""
    return "no revisit" if math.isnan(score) else f"{score:.3f}"
