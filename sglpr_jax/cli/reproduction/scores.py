"""What every method scores on every drive: the rows of tables 1 to 7, ours and the paper's."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path

from sglpr_jax.cli.reproduction.experiments import EXPERIMENTS
from sglpr_jax.cli.reproduction.runs import Runs
from sglpr_jax.cli.reproduction.tables import OURS, PUBLISHED, Row, score_or_none
from sglpr_jax.data import open_sequence, sequence_names
from sglpr_jax.evaluation.baselines import BASELINES
from sglpr_jax.evaluation.protocols import Result, bevplace_nclt_recall, top1_f1max
from sglpr_jax.evaluation.published import TABLES


@functools.cache
def top1(runs: Runs, method: str, seq: str, *, rotated: bool = False) -> Result:
    """The paper's F1max (top-1, 3 m / 20 m) of a variant or of a method without training."""
    return top1_f1max(runs.descriptors(method, seq, rotated=rotated))


def f1max_rows(name: str, runs: Runs, seqs: Sequence[str], baselines: Sequence[str]) -> list[Row]:
    """The rows of table 1, 2, 4, 5, 6 or 7, ours first."""
    rotated = EXPERIMENTS[name].rotated
    ours = []
    for method, label in methods_of(name, baselines).items():
        row = _row(label, runs, method, seqs, rotated=rotated)
        if rotated:
            row = dataclasses.replace(row, change=_change(row, _row(label, runs, method, seqs), seqs))
        ours.append(row)
    return [*ours, *published_rows(name, seqs)]


def across_sessions_rows(runs: Runs, seq: str, root: Path, baselines: Sequence[str]) -> tuple[list[str], list[Row]]:
    """The columns and rows of table 3: Recall@1 of each later session of `root` in the first one.

    The model is the one trained without `seq`; it has seen none of the sessions. Methods that need labels are left out
    where there are none.
    """
    database, *queries = (open_sequence(root, name) for name in sequence_names(root))
    fitting = [name for name in baselines if BASELINES[name].input != "labelled points" or database.has_labels]
    ours = []
    for method, label in methods_of("table3", fitting).items():
        there = runs.descriptors(method, seq, of=database)
        found = {q.name: bevplace_nclt_recall(there, runs.descriptors(method, seq, of=q)).score for q in queries}
        ours.append(Row(label, OURS, {name: score_or_none(score) for name, score in found.items()}))
    columns = [query.name for query in queries]
    return columns, [*ours, *published_rows("table3", columns)]


def methods_of(name: str, baselines: Sequence[str]) -> Mapping[str, str]:
    """What a table or figure calls its variants, and the methods without training beside them, by their names."""
    experiment = EXPERIMENTS[name]
    return experiment.names() | ({other: other for other in baselines} if experiment.beside_baselines else {})


def published_rows(name: str, columns: Sequence[str]) -> list[Row]:
    """The paper's rows of a table, where it has any of these columns."""
    return [
        Row(row.method, PUBLISHED, dict(zip(table.columns, row.scores, strict=True)))
        for table in TABLES
        if name == f"table{table.number}" and set(columns) & set(table.columns)
        for row in table.rows
    ]


def _row(label: str, runs: Runs, method: str, seqs: Sequence[str], *, rotated: bool = False) -> Row:
    return Row(label, OURS, {seq: score_or_none(top1(runs, method, seq, rotated=rotated).score) for seq in seqs})


def _change(turned: Row, raw: Row, seqs: Sequence[str]) -> float | None:
    after, before = turned.mean(seqs), raw.mean(seqs)
    return None if after is None or before is None else after - before
