"""Tables 1 to 7 with the reproduced and the published numbers, for the terminal, as JSON and as Markdown."""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.evaluation.protocols import PROTOCOLS
from sglpr_jax.evaluation.protocols.protocol import Result
from sglpr_jax.evaluation.protocols.recall import BEVPLACE_NCLT_RECALL
from sglpr_jax.evaluation.published import TABLES
from sglpr_jax.evaluation.report import PrintsItself, TextTable, score_or_none
from sglpr_jax.files import write_json, write_text
from sglpr_jax.reproduce.experiments import EXPERIMENTS, TOP1
from sglpr_jax.reproduce.runs import Runs, content_of

OURS, PUBLISHED = "here", "published"
NONE, NO_REVISITS = "-", "no revisits"
"""Text of a cell without a number, and of a missing score of a reproduced row."""


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
        values = [self.scores.get(name) for name in columns]
        return None if None in values or not values else sum(values) / len(values)  # type: ignore[arg-type]


@dataclass(frozen=True, repr=False)
class PaperTable(PrintsItself):
    """A table of the paper: the reproduced rows, then the published ones. It can be printed."""

    title: str
    rows: Sequence[Row]
    columns: Sequence[str]
    caption: str

    def __rich__(self) -> TextTable:
        head, *rows = self._lines()
        return TextTable(head, rows, head[2:], self.title, self.caption)

    def markdown(self) -> str:
        """Return the table as Markdown."""
        head, *rows = self._lines()
        table = "\n".join(f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *rows))
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
        has_change = any(row.change is not None for row in self.rows)
        lines = [["method", "source", *self.columns, "mean", *(["change"] if has_change else [])]]
        for row in self.rows:
            missing = NO_REVISITS if row.source == OURS else NONE
            scores = (_text(row.scores.get(name), missing) for name in self.columns)
            change = NONE if row.change is None else f"{row.change:+.3f}"
            cells = [row.label, row.source, *scores, _text(row.mean(self.columns)), change]
            lines.append(cells[: len(lines[0])])
        return lines


@dataclass(frozen=True)
class Reproduction:
    """Finished runs, test recordings and compared methods: the input of tables and figures."""

    runs: Runs
    seqs: tuple[str, ...]
    """Test recordings."""
    methods: tuple[str, ...]
    """Handcrafted methods and weights for comparison."""
    sessions: Callable[[], Path]
    """Returns the folder of sessions in NCLT's layout. Called only by experiments that need sessions."""
    trained: bool = True
    """Whether there are runs of the variants."""

    def tables(self, name: str) -> dict[str, PaperTable]:
        """Return the tables with the reproduced numbers and the paper's, one for each protocol, by file name."""
        if EXPERIMENTS[name].across_sessions:
            return {name: self._across_sessions(name)}
        return {
            name if protocol == TOP1 else f"{name}-{protocol}": self._of_protocol(name, protocol)
            for protocol in EXPERIMENTS[name].protocols
        }

    def labels(self, name: str) -> Mapping[str, str]:
        """Return the label of each variant of a table or figure by its name, and of the methods compared with them."""
        experiment = EXPERIMENTS[name]
        variants = experiment.names() if self.trained else {}
        return variants | ({other: other for other in self.methods} if experiment.beside_handcrafted else {})

    def _of_protocol(self, name: str, protocol: str) -> PaperTable:
        """Return table 1, 2, 4, 5, 6 or 7 by one protocol, the reproduced rows first.

        With rotated scans, rows have the change of their mean.
        """
        experiment, rows = EXPERIMENTS[name], []
        for method, label in self.labels(name).items():
            row = self._row(method, label, protocol, rotated=experiment.rotated)
            if experiment.rotated:
                after = row.mean(self.seqs)
                before = self._row(method, label, protocol, rotated=False).mean(self.seqs)
                row = replace(row, change=None if after is None or before is None else after - before)
            rows.append(row)
        published = protocol if len(experiment.protocols) > 1 else None
        poses = dict.fromkeys(self.runs.recording(seq).pose_source for seq in self.seqs)
        caption = [f"{protocol} ({PROTOCOLS[protocol].rule})", f"poses: {', '.join(map(str, poses))}"]
        return self._table(name, self.seqs, rows, "leave-one-out", caption, protocol=published)

    def _row(self, method: str, label: str, protocol: str, *, rotated: bool) -> Row:
        results = {seq: scored(self.runs, method, seq, protocol=protocol, rotated=rotated) for seq in self.seqs}
        return Row(label, OURS, {seq: score_or_none(result.score) for seq, result in results.items()})

    def _across_sessions(self, name: str) -> PaperTable:
        """Return Recall@1 of each later session in the first one.

        The model was trained without the first test recording and has seen none of the sessions. Methods that need
        labels are omitted if the sessions have no labels.
        """
        root, seq = self.sessions(), self.seqs[0]
        database, *queries = (open_recording(root, session) for session in recording_names(root))
        ours = []
        for method, label in self.labels(name).items():
            if method in self.methods and content_of(method) == "labelled points" and not database.has_labels:
                continue
            there = self.runs.descriptors(method, seq, of=database)
            found = {q.name: BEVPLACE_NCLT_RECALL(there, self.runs.descriptors(method, seq, of=q)) for q in queries}
            ours.append(Row(label, OURS, {name: score_or_none(result.score) for name, result in found.items()}))
        columns = [query.name for query in queries]
        return self._table(name, columns, ours, f"without recording {seq}", ["Recall@1 within 5 m"])

    def _table(
        self,
        name: str,
        columns: Sequence[str],
        ours: Sequence[Row],
        split: str,
        caption: Sequence[str],
        *,
        protocol: str | None = None,
    ) -> PaperTable:
        """Return the reproduced rows and then the published ones, of one protocol if it is given."""
        published = published_rows(name, columns, protocol=protocol)
        steps = f"here: preset {Path(self.runs.preset).stem}, {self.runs.config.steps} steps, {split}"
        source = ["published: the paper's numbers, on the real dataset"] if published else []
        caption = [*([steps] if self.trained else []), *caption, *source]
        title = f"{name}: {EXPERIMENTS[name].title}"
        return PaperTable(title, [*ours, *published], list(columns), "; ".join(caption))


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


@functools.cache
def scored(runs: Runs, method: str, seq: str, *, protocol: str = TOP1, rotated: bool = False) -> Result:
    """Return the result of a variant, a handcrafted method or weights, by default by the paper's protocol."""
    return PROTOCOLS[protocol](runs.descriptors(method, seq, rotated=rotated))


def write_tables(name: str, found: Reproduction, folder: Path) -> list[PaperTable]:
    """Compute the tables of an experiment and write them as JSON and as Markdown. Returns the tables."""
    tables = found.tables(name)
    folder.mkdir(parents=True, exist_ok=True)
    for file, table in tables.items():
        write_text(folder / f"{file}.md", table.markdown())
        write_json(folder / f"{file}.json", table.to_json())
    return list(tables.values())


def _text(score: float | None, missing: str = NONE) -> str:
    return missing if score is None else f"{score:.3f}"
