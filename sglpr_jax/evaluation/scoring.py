"""Scores descriptors, top-k lists and scored pairs. The results are an `Evaluation`, which prints itself as tables."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from rich.console import Console, ConsoleOptions

from sglpr_jax.data.formats.pose_files import Trajectory
from sglpr_jax.evaluation import published as paper
from sglpr_jax.evaluation import report
from sglpr_jax.evaluation.inputs import as_descriptors, check_agreement, read_input
from sglpr_jax.evaluation.protocols import PROTOCOLS, chosen_protocols, score
from sglpr_jax.evaluation.protocols.protocol import Input, ScoredPairs, TopK, kind_of
from sglpr_jax.evaluation.protocols.result import Decision, Result
from sglpr_jax.files import naming, printable
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.distances import distance_function

MISTAKE_GAP = 10
"""Minimum gap between the queries of listed false positives, in frames: neighbouring frames make the same mistake."""
MOST_MISTAKES = 6
"""Maximum number of listed false positives."""


@dataclass(frozen=True)
class FalsePositive:
    """Answer that is accepted at the threshold of F1max but shows another place than the query."""

    query: int
    answer: int
    """Frame numbers of the query and its answer."""
    metres: float
    """Distance between the positions of the two frames in metres, in 2-D or 3-D like the protocol."""
    distance: float
    """Distance between the two descriptors."""


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation(report.PrintsItself):
    """Results of methods on one recording, or of one method on several query sessions. Prints itself as tables."""

    title: str
    about: str
    """Description of the input and its distance, in one line."""
    methods: Mapping[str, Sequence[Result]]
    """Results, one for each protocol, by the name of the method. The first method is the evaluated one; the others are
    for comparison. With a database session, the keys are query sessions instead of methods."""
    positions: Float[np.ndarray, "n 3"] | None = None
    """Position of each frame in metres, z up. None across sessions and for labelled pairs without positions."""
    published: Sequence[tuple[str, ...]] = ()
    """Rows of a table with the paper's numbers, if requested."""
    made_with: Mapping[str, Any] = field(default_factory=dict)
    """Files, configuration, weights and distance of the descriptors, as values for JSON."""
    database: str | None = None
    """Name of the database session. None for one recording."""

    @property
    def results(self) -> Sequence[Result]:
        """Results of the evaluated method, one for each protocol and, across sessions, for each query session."""
        if self.database is None:
            return next(iter(self.methods.values()))
        return [result for results in self._by_protocol().values() for result in results]

    @cached_property
    def thresholded_result(self) -> Result | None:
        """First result of a protocol that accepts answers up to a distance threshold, or None."""
        return next((result for result in self.results if result.answers is not None), None)

    @cached_property
    def worst_false_positives(self) -> Sequence[FalsePositive]:
        """Up to 6 false positives of `thresholded_result` by descriptor distance, at least 10 frames apart."""
        result, positions = self.thresholded_result, self.positions
        if result is None or positions is None:
            return []
        assert result.answers is not None and result.answer_distances is not None and result.decisions is not None
        false_positives = np.flatnonzero(result.decisions == Decision.FALSE_POSITIVE)
        by_distance = false_positives[np.argsort(result.answer_distances[false_positives], kind="stable")]
        worst: list[FalsePositive] = []
        for query in by_distance.tolist():
            if len(worst) < MOST_MISTAKES and all(abs(query - other.query) >= MISTAKE_GAP for other in worst):
                answer = int(result.answers[query])
                metres = float(np.linalg.norm((positions[query] - positions[answer])[: result.dimensions]))
                worst.append(FalsePositive(query, answer, metres, float(result.answer_distances[query])))
        return worst

    def _by_protocol(self) -> dict[str, tuple[Result, ...]]:
        """Return the results of all methods or query sessions, by the protocol's name on the command line."""
        name_of_title = {protocol.title: name for name, protocol in PROTOCOLS.items()}
        return {name_of_title[results[0].name]: results for results in zip(*self.methods.values(), strict=True)}

    def table(self) -> report.TextTable:
        """Return the table of all scores: by method, or by query session with their mean and the paper's numbers."""
        if self.database is None:
            return report.comparison(self.methods)
        header = ("", *map(printable, self.methods), "mean")
        rows = []
        for name, results in self._by_protocol().items():
            scores = [*(result.score for result in results), report.mean_score(results)]
            rows.append((name, *map(report.format_score, scores)))
        return report.TextTable(header, [*rows, *self.published], header[1:], self.title)

    def published_tables(self) -> list[report.TextTable | str]:
        """Return the paper's numbers, if requested, and a note on them. Across sessions `table` has the numbers."""
        if not self.published:
            return []
        if self.database is not None:
            return [paper.TABLE_3_NOTE]
        header = ("method", "published F1max", "numbers from")
        return [report.TextTable(header, self.published, header[1:2]), paper.TABLE_1_NOTE]

    def to_json(self) -> dict[str, Any]:
        """Return plain values for `json.dump`."""
        if self.database is not None:
            results = {
                name: {
                    "mean": report.score_or_none(report.mean_score(results)),
                    "sessions": dict(zip(self.methods, report.to_json(results), strict=True)),
                }
                for name, results in self._by_protocol().items()
            }
            values = {**self.made_with, "database_session": self.database, "results": results}
            if self.published:
                columns = self.table().header
                values["published"] = {"about": paper.TABLE_3_NOTE, "columns": columns, "rows": self.published}
            return values
        return {
            **self.made_with,
            "results": report.to_json(self.results),
            "false_positives": [dataclasses.asdict(pair) for pair in self.worst_false_positives],
            "compared": {name: report.to_json(results) for name, results in list(self.methods.items())[1:]},
            "published": self.published,
        }

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[report.TextTable | str]:
        has_sessions = self.database is not None
        yield report.results_table(self.results, title="" if has_sessions else self.title)
        if not has_sessions and any(result.curve is not None for result in self.results):
            yield report.threshold_table(self.results)
        if has_sessions or len(self.methods) > 1:
            yield self.table()
        yield from self.published_tables()


def evaluate(
    source: Input | Path | str | ArrayLike,
    protocols: Sequence[str] = (),
    *,
    positions: ArrayLike | None = None,
    times: ArrayLike | None = None,
    distance: str | None = None,
    published: bool = False,
) -> Evaluation:
    """Score descriptors, a top-k list or scored pairs.

    Arguments:
      source: A file that `evaluation.inputs` can read, an opened input, or an array (n, d) of descriptors.
      protocols: Names in `PROTOCOLS`. `all` selects every protocol that fits the source. By default, the default
        protocols that fit are used, or every protocol that fits if no default does.
      positions: Positions (n, 3) of the frames in metres, z up. They replace the positions of `source`.
      times: Times (n,) of the frames in seconds. They replace the times of `source`.
      distance: Name of the distance between descriptors. By default the distance of `source`, or L2 for an array.
      published: Whether to add the numbers of the paper for the sequence.

    Raises ValueError if positions are missing, or if a protocol or an option does not fit the source.

    Example:
      print(sglpr_jax.evaluate("08.npz"))
    """
    times = None if times is None else np.asarray(times, np.float64)
    trajectory = None
    if positions is not None:
        trajectory = Trajectory(np.asarray(positions, np.float64), times, "positions given as an array", by_row=True)
    if isinstance(source, str | Path):
        path = Path(source)
        file_input = read_input(path, trajectory, sequence=path.stem, distance=distance)
        if trajectory is None:  # otherwise `read_input` has set the times, too
            with naming(path):
                file_input = _with_fields(file_input, times=times)
        return evaluate_methods({path.stem: file_input}, protocols, published=published, file=path)
    if distance is not None:
        distance_function(distance)  # raises ValueError if the name is unknown
    if isinstance(source, Input):
        source = _with_fields(
            source,
            times=times,
            positions=trajectory and trajectory.positions,
            pose_source=trajectory and trajectory.source,
            distance=distance,
        )
    else:
        rows = np.asarray(source)
        if rows.ndim != 2:
            raise ValueError(
                f"expected a file, an opened input, or descriptors (n, d), found an array of shape {rows.shape}"
            )
        if trajectory is None:
            raise ValueError(f"expected positions of {len(rows)} frames beside their descriptors, found none")
        source = as_descriptors(rows, trajectory, sequence="", method="", distance=distance or "l2")
    return evaluate_methods({"descriptors": source}, protocols, published=published)


def _with_fields(source: Input, **fields: Any) -> Input:
    """Replace the fields that are not None. Raises ValueError if this kind of input has no such field."""
    fields = {name: value for name, value in fields.items() if value is not None}
    for name in fields:
        if not hasattr(source, name):
            raise ValueError(f"expected no {name} beside {_about(source)}, found {name}")
    return dataclasses.replace(source, **fields)


def evaluate_methods(
    methods: Mapping[str, Input], protocols: Sequence[str] = (), *, published: bool = False, file: Path | None = None
) -> Evaluation:
    """Score several methods by the same protocols.

    Arguments:
      methods: Input of each method, by name. The first method is the evaluated one.
      protocols: Names in `PROTOCOLS`. Without names, or with `all`, they are chosen to fit the first method.
      published: Whether to add the numbers of the paper for the sequence.
      file: File of the first method, for the title and the JSON.

    Raises ValueError, with the name of the method, if a method cannot be scored or has other frames than the first.
    """
    first = next(iter(methods.values()))
    protocol_names = chosen_protocols(kind_of(first), protocols)
    published_rows = paper.table_1_rows(first.sequence) if published else ()  # an error before the scoring
    results = {}
    for method, source in methods.items():
        with naming(method):
            check_agreement(first, source)
            results[method] = score(source, protocol_names)
    if isinstance(first, ScoredPairs):
        title = f"{'pairs' if file is None else file.name}, {len(first.pairs)} pairs"
    else:
        title = f"sequence {printable(first.sequence)}, {len(first)} scans"
    made_with: dict[str, Any] = {} if file is None else {"file": str(file)}
    if isinstance(first, DescriptorFile):
        made_with |= {"config": first.config, "weights_hash": first.weights_hash, "distance": first.distance}
    return Evaluation(
        title=title,
        about=_about(first) if file is None else f"{file}: {_about(first)}",
        methods=results,
        positions=first.positions,
        published=published_rows,
        made_with=made_with,
    )


def _about(source: Input) -> str:
    """Describe an input in a few words, with the name of its descriptor distance if it has one."""
    if isinstance(source, ScoredPairs):
        return "scored pairs" + (" with labels" if source.labels is not None else "")
    if isinstance(source, TopK):
        return f"up to {source.nearest.shape[1]} retrieved frames for each of {len(source.queries)} queries"
    return f"descriptors of {source.descriptors.shape[1]} numbers, compared by {source.distance}"
