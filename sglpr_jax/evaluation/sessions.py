"""Evaluation across sessions: one session is the database, the others are queries, as in table 3 of the paper."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sglpr_jax.evaluation.inputs import read_descriptor_file
from sglpr_jax.evaluation.protocols import PROTOCOLS, chosen_protocols
from sglpr_jax.evaluation.protocols.protocol import positions_of
from sglpr_jax.evaluation.published import table_3_rows
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
    first, *files = map(read_descriptor_file, (database, *queries))
    for path, file in zip(queries, files, strict=True):
        with naming(path):
            check_same_method(first, file)
    protocols = [PROTOCOLS[name] for name in chosen_protocols("sessions", names)]
    sessions = [file.sequence for file in files]
    if len({first.sequence, *sessions}) <= len(sessions):
        raise ValueError(f"expected different sessions, found database {first.sequence}, queries {', '.join(sessions)}")
    for file in files:
        _check_one_world(first, file)
    width = first.descriptors.shape[1]
    return Evaluation(
        title=f"database {printable(first.sequence)}; queries of {len(sessions)} sessions",
        about=f"{database}: descriptors of {width} numbers, compared by {first.distance}",
        methods={file.sequence: [protocol(first, file) for protocol in protocols] for file in files},
        published=table_3_rows(first.sequence, sessions) if published else (),
        made_with={"files": [str(path) for path in queries], "database": str(database)},
        database=first.sequence,
    )


def _check_one_world(database: DescriptorFile, queries: DescriptorFile) -> None:
    """Raise ValueError if the areas of the two sessions do not overlap. Their positions then have different frames."""
    (low, high), (low_q, high_q) = (
        (plane.min(axis=0), plane.max(axis=0)) for plane in (positions_of(database, 2), positions_of(queries, 2))
    )
    if np.any(low_q > high + APART_M) or np.any(high_q < low - APART_M):
        there, here = (
            f"x {a[0]:.0f} to {b[0]:.0f}, y {a[1]:.0f} to {b[1]:.0f} m" for a, b in ((low, high), (low_q, high_q))
        )
        raise ValueError(
            f"expected {queries.sequence} in the world frame of the database {database.sequence} ({there}), found it "
            f"elsewhere ({here}): no place is in both"
        )
