"""Tables 1 to 7 with the reproduced and the published numbers, for the terminal, as JSON and as Markdown."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sglpr_jax.evaluation.protocols import PROTOCOLS
from sglpr_jax.evaluation.protocols.recall import BEVPLACE_NCLT_RECALL
from sglpr_jax.evaluation.published import TABLES
from sglpr_jax.evaluation.report import PrintsItself, TextTable, score_or_none
from sglpr_jax.files import write_json, write_text
from sglpr_jax.methods.method import LABELLED
from sglpr_jax.reproduce.experiments import EXPERIMENTS, TOP1
from sglpr_jax.reproduce.reproduction import Reproduction, content_of

OURS, PUBLISHED = "here", "published"


@dataclass(frozen=True)
class Row:
    """Scores of one method, reproduced here (`source` is `OURS`) or published (`PUBLISHED`)."""

    label: str
    source: str
    scores: Mapping[str, float | None]
    """Score by test recording. None: no revisit, so no score."""
    change: float | None = None
    """Change of the mean score when the scans are rotated (column Cmp of table 2)."""

    def mean(self, columns: Sequence[str]) -> float | None:
        """Return the mean over these test recordings, or None if a score is missing: such means are not comparable."""
        return _mean([self.scores.get(name) for name in columns])


def _mean(scores: Sequence[float | None]) -> float | None:
    """Return the mean, or None if a score is missing or if there is no score."""
    known_scores = [score for score in scores if score is not None]
    return sum(known_scores) / len(scores) if scores and len(known_scores) == len(scores) else None


@dataclass(frozen=True, repr=False)
class PaperTable(PrintsItself):
    """A table of the paper: the reproduced rows, then the published ones. It can be printed."""

    title: str
    rows: Sequence[Row]
    columns: Sequence[str]
    """Test recordings."""
    caption: str

    def __rich__(self) -> TextTable:
        header, *rows = self._cells()
        return TextTable(header, rows, header[2:], self.title, self.caption)

    def markdown(self) -> str:
        """Return the table as Markdown."""
        header, *rows = self._cells()
        table = "\n".join(f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *rows))
        return f"**{self.title}**\n\n{table}\n\n{self.caption}\n"

    def to_json(self) -> list[dict[str, Any]]:
        """Return plain values for `json.dump`."""
        return [
            {
                "method": row.label,
                "source": row.source,
                "scores": {name: row.scores.get(name) for name in self.columns},
                "mean": row.mean(self.columns),
                "change": row.change,
            }
            for row in self.rows
        ]

    def _cells(self) -> list[list[str]]:
        """Return the cells of the header and of each row, with a column "change" if a row has a change."""
        rows = [["method", "source", *self.columns, "mean", "change"]]
        for row in self.rows:
            missing = "no revisits" if row.source == OURS else "-"
            scores = (_format_number(row.scores.get(name), missing) for name in self.columns)
            change = _format_number(row.change, format="+.3f")
            rows.append([row.label, row.source, *scores, _format_number(row.mean(self.columns)), change])
        has_change = any(row.change is not None for row in self.rows)
        return rows if has_change else [cells[:-1] for cells in rows]


def _format_number(number: float | None, missing: str = "-", *, format: str = ".3f") -> str:
    return missing if number is None else f"{number:{format}}"


def tables(reproduction: Reproduction, name: str) -> dict[str, PaperTable]:
    """Return a table for each protocol of an experiment, by file name. `name` is a key of `EXPERIMENTS`."""
    if EXPERIMENTS[name].across_sessions:
        return {name: _table_across_sessions(reproduction, name)}
    return {
        name if protocol == TOP1 else f"{name}-{protocol}": _table_by_protocol(reproduction, name, protocol)
        for protocol in EXPERIMENTS[name].protocols
    }


def _table_by_protocol(reproduction: Reproduction, name: str, protocol: str) -> PaperTable:
    """Return a table scored by one protocol. If scans are rotated, rows have the change of their mean."""
    experiment, seqs = EXPERIMENTS[name], reproduction.seqs

    def scores_of(method: str, *, rotated: bool) -> dict[str, float | None]:
        return {seq: score_or_none(reproduction.score(method, seq, protocol, rotated=rotated).score) for seq in seqs}

    rows = []
    for method, label in reproduction.labels(name).items():
        scores = scores_of(method, rotated=experiment.rotated)
        change = None
        if experiment.rotated:
            mean, mean_raw = _mean([*scores.values()]), _mean([*scores_of(method, rotated=False).values()])
            change = None if mean is None or mean_raw is None else mean - mean_raw
        rows.append(Row(label, OURS, scores, change))
    poses = dict.fromkeys(str(reproduction.recording(seq).pose_source) for seq in seqs)
    caption = ("leave-one-out", f"{protocol} ({PROTOCOLS[protocol].rule})", f"poses: {', '.join(poses)}")
    rows += published_rows(name, seqs, protocol=protocol if len(experiment.protocols) > 1 else None)
    return _captioned_table(reproduction, name, seqs, rows, *caption)


def _table_across_sessions(reproduction: Reproduction, name: str) -> PaperTable:
    """Return Recall@1 (within 5 m) of each later session in the first one, by models that were not trained on sessions.

    Methods that need labels are omitted if the sessions have no labels.
    """
    database, *queries = reproduction.session_recordings()
    seq = reproduction.seqs[0]  # the models are those trained without this recording
    rows = []
    for method, label in reproduction.labels(name).items():
        is_variant = method not in (*reproduction.weights, *reproduction.methods)
        if not is_variant and content_of(method) in LABELLED and not database.has_labels:
            continue
        database_file = reproduction.descriptors(method, seq, of=database)
        scores = {}
        for query in queries:
            result = BEVPLACE_NCLT_RECALL(database_file, reproduction.descriptors(method, seq, of=query))
            scores[query.name] = score_or_none(result.score)
        rows.append(Row(label, OURS, scores))
    columns = [query.name for query in queries]
    rows += published_rows(name, columns)
    return _captioned_table(reproduction, name, columns, rows, f"without recording {seq}", "Recall@1 within 5 m")


def _captioned_table(
    reproduction: Reproduction, name: str, columns: Sequence[str], rows: Sequence[Row], split: str, *caption: str
) -> PaperTable:
    """Return a table. Its caption also has the training (on the recordings `split`) and the source of other rows."""
    parts = list(caption)
    if reproduction.trained:
        parts.insert(0, f"here: preset {Path(reproduction.preset).stem}, {reproduction.config.steps} steps, {split}")
    if any(row.source == PUBLISHED for row in rows):
        parts.append("published: the paper's numbers, on the real dataset")
    return PaperTable(f"{name}: {EXPERIMENTS[name].title}", rows, list(columns), "; ".join(parts))


def published_rows(name: str, columns: Sequence[str], *, protocol: str | None = None) -> list[Row]:
    """Return the rows of a table in the paper, or [] if that table has none of the columns.

    With `protocol`, only the rows scored by it are returned, and the labels have the source named by the paper.
    """
    rows = []
    for table in TABLES:
        if name == f"table{table.number}" and set(columns) & set(table.columns):
            for row in table.rows:
                label = row.method if protocol is None else f"{row.method} ({row.source})"
                if protocol in (None, row.f1max_protocol):
                    rows.append(Row(label, PUBLISHED, dict(zip(table.columns, row.scores, strict=True))))
    return rows


def write_tables(reproduction: Reproduction, name: str) -> list[PaperTable]:
    """Compute the tables of an experiment and write them as JSON and as Markdown. Returns the tables."""
    table_of_file = tables(reproduction, name)
    for file, table in table_of_file.items():
        write_text(reproduction.folder / f"{file}.md", table.markdown())
        write_json(reproduction.folder / f"{file}.json", table.to_json())
    return list(table_of_file.values())
