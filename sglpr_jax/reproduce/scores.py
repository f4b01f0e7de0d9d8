"""Scores of every method on every recording: the rows of tables 1 to 7, reproduced and published."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path

from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.evaluation.protocols import PROTOCOLS
from sglpr_jax.evaluation.protocols.protocol import Result
from sglpr_jax.evaluation.protocols.sessions import BEVPLACE_NCLT_RECALL
from sglpr_jax.evaluation.published import TABLES
from sglpr_jax.evaluation.published import Row as PublishedRow
from sglpr_jax.reproduce.compared import content_of
from sglpr_jax.reproduce.experiments import EXPERIMENTS, TOP1
from sglpr_jax.reproduce.runs import Runs
from sglpr_jax.reproduce.tables import OURS, PUBLISHED, Row, score_or_none


@functools.cache
def scored(runs: Runs, method: str, seq: str, *, protocol: str = TOP1, rotated: bool = False) -> Result:
    """Return the result of a variant, a handcrafted method or weights. The default protocol is that of the paper: F1max
    of top-1 retrieval, 3 m / 20 m."""
    return PROTOCOLS[protocol](runs.descriptors(method, seq, rotated=rotated))


def f1max_rows(
    name: str, runs: Runs, seqs: Sequence[str], methods: Sequence[str], *, protocol: str = TOP1, trained: bool = True
) -> list[Row]:
    """Return the rows of table 1, 2, 4, 5, 6 or 7, the reproduced ones first.

    Arguments:
      name: Name of the table.
      runs: Runs of the variants.
      seqs: Test recordings.
      methods: Handcrafted methods and weights that are compared with the variants.
      protocol: Protocol of the scores.
      trained: Whether the table has the variants, which are trained for it.
    """
    rotated = EXPERIMENTS[name].rotated
    ours = []
    for method, label in methods_of(name, methods, trained=trained).items():
        row = _row(label, runs, method, seqs, protocol=protocol, rotated=rotated)
        if rotated:
            raw = _row(label, runs, method, seqs, protocol=protocol)
            row = dataclasses.replace(row, change=_change(row, raw, seqs))
        ours.append(row)
    several = len(EXPERIMENTS[name].protocols) > 1
    return [*ours, *published_rows(name, seqs, protocol=protocol if several else None)]


def across_sessions_rows(
    name: str, runs: Runs, seq: str, root: Path, methods: Sequence[str], *, trained: bool = True
) -> tuple[list[str], list[Row]]:
    """Return the columns and rows of a table across sessions.

    The scores are Recall@1 of each later session of `root` in the first one. The model was trained without `seq` and
    has seen none of the sessions. Methods that need labels are omitted if the sessions have no labels.
    """
    database, *queries = (open_recording(root, session) for session in recording_names(root))
    fitting = [other for other in methods if content_of(other) != "labelled points" or database.has_labels]
    ours = []
    for method, label in methods_of(name, fitting, trained=trained).items():
        there = runs.descriptors(method, seq, of=database)
        found = {q.name: BEVPLACE_NCLT_RECALL(there, runs.descriptors(method, seq, of=q)).score for q in queries}
        ours.append(Row(label, OURS, {name: score_or_none(score) for name, score in found.items()}))
    columns = [query.name for query in queries]
    return columns, [*ours, *published_rows(name, columns)]


def methods_of(name: str, methods: Sequence[str], *, trained: bool = True) -> Mapping[str, str]:
    """Return the label of each variant of a table or figure by its name, and of the methods compared with them."""
    experiment = EXPERIMENTS[name]
    variants = experiment.names() if trained else {}
    return variants | ({other: other for other in methods} if experiment.beside_handcrafted else {})


def published_rows(name: str, columns: Sequence[str], *, protocol: str | None = None) -> list[Row]:
    """Return the paper's rows of a table, if it has any of these columns.

    With a protocol, only the rows that were scored by it are returned. The source that the paper names then stands
    beside each method.
    """
    return [
        Row(_label(row, protocol), PUBLISHED, dict(zip(table.columns, row.scores, strict=True)))
        for table in TABLES
        if name == f"table{table.number}" and set(columns) & set(table.columns)
        for row in table.rows
        if protocol in (None, row.f1max_protocol)
    ]


def _label(row: PublishedRow, protocol: str | None) -> str:
    """Return the method and, in a table of one protocol, the source of its scores."""
    return row.method if protocol is None else f"{row.method} ({row.source})"


def _row(
    label: str, runs: Runs, method: str, seqs: Sequence[str], *, protocol: str = TOP1, rotated: bool = False
) -> Row:
    options = {"protocol": protocol, "rotated": rotated}
    return Row(label, OURS, {seq: score_or_none(scored(runs, method, seq, **options).score) for seq in seqs})


def _change(rotated: Row, raw: Row, seqs: Sequence[str]) -> float | None:
    after, before = rotated.mean(seqs), raw.mean(seqs)
    return None if after is None or before is None else after - before
