"""Evaluation across sessions: one session is the database, the others are queries, as in table 3 of the paper."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.evaluation.inputs import read_descriptor_file
from sglpr_jax.evaluation.protocols import PROTOCOLS, chosen_protocols
from sglpr_jax.evaluation.protocols.protocol import positions_of
from sglpr_jax.evaluation.published import table_3_rows
from sglpr_jax.evaluation.scoring import Evaluation
from sglpr_jax.files import naming, printable
from sglpr_jax.retrieval.descriptor_file import DescriptorFile, check_same_method

APART_M = 25.0
"""Largest radius of one place, in metres, of the protocols across sessions (`pointnetvlad-recall`)."""


def evaluate_sessions(
    database: Path, queries: Sequence[Path], names: Sequence[str] = (), *, published: bool = False
) -> Evaluation:
    """Score the retrieval of several query sessions in one database session.

    Arguments:
      database: Descriptor file of the database session.
      queries: Descriptor file of each query session.
      names: Names of the protocols. Without names, or with `all`, every protocol across sessions is used.
      published: Whether to add the rows of table 3 of the paper.

    Raises ValueError if a file has no positions, if a session occurs twice, does not overlap with the database or has
    descriptors of another method, or if a protocol is unknown.
    """
    for path in (database, *queries):
        if path.suffix != ".npz":
            raise ValueError(f"{path}: expected descriptor files of bin/embed (.npz) for an evaluation across sessions")
    database_file, *query_files = map(read_descriptor_file, (database, *queries))
    for path, file in zip(queries, query_files, strict=True):
        with naming(path):
            check_same_method(database_file, file)
    protocols = [PROTOCOLS[name] for name in chosen_protocols("sessions", names)]
    files = [database_file, *query_files]
    if len({file.sequence for file in files}) < len(files):
        for one, other in itertools.combinations(files, 2):
            if one.sequence == other.sequence and np.array_equal(positions_of(one, 3), positions_of(other, 3)):
                sessions = f"database {files[0].sequence}, queries {', '.join(file.sequence for file in files[1:])}"
                raise ValueError(f"expected different sessions, found {sessions}")
        # Recordings of several datasets may have one name, such as 00. The names of their files differ.
        paths = (database, *queries)
        files = [replace(file, sequence=str(path.with_suffix(""))) for path, file in zip(paths, files, strict=True)]
    database_file, *query_files = files
    database_name, query_names = database_file.sequence, [file.sequence for file in query_files]
    for file in query_files:
        _check_overlap(database_file, file)
    width = database_file.descriptors.shape[1]
    return Evaluation(
        title=f"database {printable(database_name)}; queries of {len(query_names)} sessions",
        about=f"{database}: descriptors of {width} numbers, compared by {database_file.distance}",
        methods={file.sequence: [protocol(database_file, file) for protocol in protocols] for file in query_files},
        published=table_3_rows(database_name, query_names) if published else (),
        made_with={"files": [str(path) for path in queries], "database": str(database)},
        database=database_name,
    )


def _check_overlap(database: DescriptorFile, queries: DescriptorFile) -> None:
    """Raise ValueError if the areas of two sessions are more than 25 m apart. Their world frames then differ."""
    database_xy, query_xy = positions_of(database, 2), positions_of(queries, 2)
    is_beyond = query_xy.min(axis=0) > database_xy.max(axis=0) + APART_M
    is_before = query_xy.max(axis=0) < database_xy.min(axis=0) - APART_M
    if np.any(is_beyond | is_before):
        raise ValueError(
            f"expected {queries.sequence} in the world frame of the database {database.sequence} "
            f"({_area(database_xy)}), found it elsewhere ({_area(query_xy)}): no place is in both"
        )


def _area(xy: Float[np.ndarray, "n 2"]) -> str:
    (min_x, min_y), (max_x, max_y) = xy.min(axis=0), xy.max(axis=0)
    return f"x {min_x:.0f} to {max_x:.0f}, y {min_y:.0f} to {max_y:.0f} m"
