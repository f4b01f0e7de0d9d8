"""The rows of tables 1, 2 and 4 to 7: our top-1 F1max of every method and drive, and the paper's."""

from collections.abc import Sequence

from sglpr_jax.cli.reproduction.experiments import EXPERIMENTS, FULL
from sglpr_jax.cli.reproduction.results import top1
from sglpr_jax.cli.reproduction.runs import Runs
from sglpr_jax.cli.reproduction.tables import OURS, PUBLISHED, Row, score_or_none
from sglpr_jax.evaluation.protocols import Result


def f1max_rows(name: str, runs: Runs, seqs: Sequence[str], baselines: Sequence[str]) -> list[Row]:
    """The rows of a table by its name, ours first."""
    experiment = EXPERIMENTS[name]
    labels = experiment.names() | ({name: name for name in baselines} if experiment.beside_baselines else {})
    ours = [_row(label, runs, method, seqs, rotated=experiment.rotated) for method, label in labels.items()]
    return [*ours, *published_rows(name, seqs)]


def _row(label: str, runs: Runs, method: str, seqs: Sequence[str], *, rotated: bool) -> Row:
    row = Row(label, OURS, {seq: score_or_none(top1(runs, method, seq, rotated=rotated).score) for seq in seqs})
    return replace(row, change=_change(row, _row(label, runs, method, seqs, rotated=False), seqs)) if rotated else row


def _change(turned: Row, raw: Row, seqs: Sequence[str]) -> float | None:
    after, before = turned.mean(seqs), raw.mean(seqs)
    return None if after is None or before is None else after - before
