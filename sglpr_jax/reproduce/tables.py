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
from sglpr_jax.reproduce.experiments import EXPERIMENTS, TOP1
from sglpr_jax.reproduce.reproduction import Reproduction, content_of

OURS, PUBLISHED = "here", "published"


@dataclass(frozen=True)
class Row:
    """Scores of one method by test recording (None: no score), reproduced here or published."""

    label: str
    source: str
    scores: Mapping[str, float | None]
    change: float | None = None
    """Change of the mean when the scans are rotated (table 2's Cmp)."""

    def mean(self, columns: Sequence[str]) -> float | None:
        """Return the mean over the columns, or None if a column is missing: such means are not comparable."""
        return _mean([self.scores.get(name) for name in columns])


def _mean(scores: Sequence[float | None]) -> float | None:
    known = [score for score in scores if score is not None]
    return sum(known) / len(known) if known and len(known) == len(scores) else None


@dataclass(frozen=True, repr=False)
class PaperTable(PrintsItself):
    """A table of the paper: the reproduced rows, then the published ones. It can be printed."""

    title: str
    rows: Sequence[Row]
    columns: Sequence[str]
    caption: str

    def __rich__(self) -> TextTable:
        header, *rows = self._lines()
        return TextTable(header, rows, header[2:], self.title, self.caption)

    def markdown(self) -> str:
        """Return the table as Markdown."""
        header, *rows = self._lines()
        table = "\n".join(f"| {' | '.join(line)} |" for line in (header, ["---"] * len(header), *rows))
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

    def _lines(self) -> list[list[str]]:
        """Return the cells of the header and of each row."""
        with_change = any(row.change is not None for row in self.rows)
        lines = [["method", "source", *self.columns, "mean", *(["change"] if with_change else [])]]
        for row in self.rows:
            missing = "no revisits" if row.source == OURS else "-"
            scores = (_text(row.scores.get(name), missing) for name in self.columns)
            change = [_text(row.change, format="+.3f")] if with_change else []
            lines.append([row.label, row.source, *scores, _text(row.mean(self.columns)), *change])
        return lines


def _text(number: float | None, missing: str = "-", *, format: str = ".3f") -> str:
    return missing if number is None else f"{number:{format}}"


def tables(reproduction: Reproduction, name: str) -> dict[str, PaperTable]:
    """Return the tables with the reproduced numbers and the paper's, one for each protocol, by file name."""
    if EXPERIMENTS[name].across_sessions:
        return {name: _across_sessions(reproduction, name)}
    return {
        name if protocol == TOP1 else f"{name}-{protocol}": _by_protocol(reproduction, name, protocol)
        for protocol in EXPERIMENTS[name].protocols
    }


def _by_protocol(reproduction: Reproduction, name: str, protocol: str) -> PaperTable:
    """Return table 1, 2, 4, 5, 6 or 7 by one protocol. With rotated scans, rows have the change of their mean."""
    experiment, seqs, rows = EXPERIMENTS[name], reproduction.seqs, []

    def scores_of(method: str, *, rotated: bool) -> dict[str, float | None]:
        return {seq: score_or_none(reproduction.score(method, seq, protocol, rotated=rotated).score) for seq in seqs}

    for method, label in reproduction.labels(name).items():
        scores, change = scores_of(method, rotated=experiment.rotated), None
        if experiment.rotated:
            after, before = (_mean(list(one.values())) for one in (scores, scores_of(method, rotated=False)))
            change = None if after is None or before is None else after - before
        rows.append(Row(label, OURS, scores, change))
    poses = dict.fromkeys(str(reproduction.recording(seq).pose_source) for seq in seqs)
    caption = ("leave-one-out", f"{protocol} ({PROTOCOLS[protocol].rule})", f"poses: {', '.join(poses)}")
    published = published_rows(name, seqs, protocol=protocol if len(experiment.protocols) > 1 else None)
    return _table(reproduction, name, seqs, [*rows, *published], *caption)


def _across_sessions(reproduction: Reproduction, name: str) -> PaperTable:
    """Return Recall@1 of each later session in the first one.

    The model was trained without the first test recording and has seen none of the sessions. Methods that need labels
    are omitted if the sessions have no labels.
    """
    (database, *queries), seq, rows = reproduction.session_recordings(), reproduction.seqs[0], []
    compared = (*reproduction.weights, *reproduction.methods)
    for method, label in reproduction.labels(name).items():
        if method in compared and content_of(method) == "labelled points" and not database.has_labels:
            continue
        file = reproduction.descriptors(method, seq, of=database)
        scores = {}
        for query in queries:
            result = BEVPLACE_NCLT_RECALL(file, reproduction.descriptors(method, seq, of=query))
            scores[query.name] = score_or_none(result.score)
        rows.append(Row(label, OURS, scores))
    columns = [query.name for query in queries]
    rows += published_rows(name, columns)
    return _table(reproduction, name, columns, rows, f"without recording {seq}", "Recall@1 within 5 m")


def _table(
    reproduction: Reproduction, name: str, columns: Sequence[str], rows: Sequence[Row], split: str, *caption: str
) -> PaperTable:
    """Return a table with a caption that says how its rows were made. `split` describes the training recordings."""
    parts = list(caption)
    if reproduction.trained:
        parts.insert(0, f"here: preset {Path(reproduction.preset).stem}, {reproduction.config.steps} steps, {split}")
    if any(row.source == PUBLISHED for row in rows):
        parts.append("published: the paper's numbers, on the real dataset")
    return PaperTable(f"{name}: {EXPERIMENTS[name].title}", rows, list(columns), "; ".join(parts))


def published_rows(name: str, columns: Sequence[str], *, protocol: str | None = None) -> list[Row]:
    """Return the paper's rows of a table, if it has any of these columns.

    With a protocol, these are the rows that were scored by it, with the source that the paper names beside each method.
    """
    return [
        Row(
            row.method if protocol is None else f"{row.method} ({row.source})",
            PUBLISHED,
            dict(zip(table.columns, row.scores, strict=True)),
        )
        for table in TABLES
        if name == f"table{table.number}" and set(columns) & set(table.columns)
        for row in table.rows
        if protocol in (None, row.f1max_protocol)
    ]


def write_tables(reproduction: Reproduction, name: str) -> list[PaperTable]:
    """Compute the tables of an experiment and write them as JSON and as Markdown. Returns the tables."""
    by_file, folder = tables(reproduction, name), reproduction.folder
    for file, table in by_file.items():
        write_text(folder / f"{file}.md", table.markdown())
        write_json(folder / f"{file}.json", table.to_json())
    return list(by_file.values())
