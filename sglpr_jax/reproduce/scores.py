"""Scores of every method on every recording: the rows of tables 1 to 7, reproduced and published."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path

from sglpr_jax.data import open_recording, recording_names
from sglpr_jax.evaluation.protocols import Result
from sglpr_jax.evaluation.protocols.bevplace_nclt_recall import bevplace_nclt_recall
from sglpr_jax.evaluation.protocols.top1_f1max import top1_f1max
from sglpr_jax.evaluation.published import TABLES
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.reproduce.experiments import EXPERIMENTS
from sglpr_jax.reproduce.runs import Runs
from sglpr_jax.reproduce.tables import OURS, PUBLISHED, Row, score_or_none


@functools.cache
def top1(runs: Runs, method: str, seq: str, *, rotated: bool = False) -> Result:
    """Return the paper's F1max (top-1, 3 m / 20 m) of a variant or of a handcrafted method."""
    return top1_f1max(runs.descriptors(method, seq, rotated=rotated))


def f1max_rows(name: str, runs: Runs, seqs: Sequence[str], methods: Sequence[str]) -> list[Row]:
    """Return the rows of table 1, 2, 4, 5, 6 or 7, the reproduced ones first."""
    rotated = EXPERIMENTS[name].rotated
    ours = []
    for method, label in methods_of(name, methods).items():
        row = _row(label, runs, method, seqs, rotated=rotated)
        if rotated:
            row = dataclasses.replace(row, change=_change(row, _row(label, runs, method, seqs), seqs))
        ours.append(row)
    return [*ours, *published_rows(name, seqs)]


def across_sessions_rows(
    name: str, runs: Runs, seq: str, root: Path, methods: Sequence[str]
) -> tuple[list[str], list[Row]]:
    """Return the columns and rows of a table across sessions.

    The scores are Recall@1 of each later session of `root` in the first one. The model was trained without `seq` and
    has seen none of the sessions. Methods that need labels are omitted if the sessions have no labels.
    """
    database, *queries = (open_recording(root, session) for session in recording_names(root))
    fitting = [other for other in methods if HANDCRAFTED[other].takes != "labelled points" or database.has_labels]
    ours = []
    for method, label in methods_of(name, fitting).items():
        there = runs.descriptors(method, seq, of=database)
        found = {q.name: bevplace_nclt_recall(there, runs.descriptors(method, seq, of=q)).score for q in queries}
        ours.append(Row(label, OURS, {name: score_or_none(score) for name, score in found.items()}))
    columns = [query.name for query in queries]
    return columns, [*ours, *published_rows(name, columns)]


def methods_of(name: str, methods: Sequence[str]) -> Mapping[str, str]:
    """Return the label of each variant of a table or figure by its name, and of the handcrafted methods."""
    experiment = EXPERIMENTS[name]
    return experiment.names() | ({other: other for other in methods} if experiment.beside_handcrafted else {})


def published_rows(name: str, columns: Sequence[str]) -> list[Row]:
    """Return the paper's rows of a table, if it has any of these columns."""
    return [
        Row(row.method, PUBLISHED, dict(zip(table.columns, row.scores, strict=True)))
        for table in TABLES
        if name == f"table{table.number}" and set(columns) & set(table.columns)
        for row in table.rows
    ]


def _row(label: str, runs: Runs, method: str, seqs: Sequence[str], *, rotated: bool = False) -> Row:
    return Row(label, OURS, {seq: score_or_none(top1(runs, method, seq, rotated=rotated).score) for seq in seqs})


def _change(rotated: Row, raw: Row, seqs: Sequence[str]) -> float | None:
    after, before = rotated.mean(seqs), raw.mean(seqs)
    return None if after is None or before is None else after - before
