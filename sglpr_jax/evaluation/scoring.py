"""Scoring of descriptors, top-k lists and scored pairs, with a result that prints itself."""

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
"""Minimum gap between the queries of two shown mistakes, in frames. Neighbouring frames make the same mistake."""
MOST_MISTAKES = 6


@dataclass(frozen=True)
class FalsePositive:
    """Answer that is accepted at the threshold of F1max but shows another place."""

    query: int
    answer: int
    metres: float
    """Distance between the positions of the two frames, in metres and in the dimensions of the protocol."""
    distance: float
    """Distance between the two descriptors."""


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation(report.PrintsItself):
    """Results of methods on one recording, or of one method across sessions. Prints itself as tables."""

    title: str
    about: str
    """Description of the input and its distance, in one line."""
    methods: Mapping[str, Sequence[Result]]
    """Results by the name of the method, one for each protocol. The first method is the evaluated one; the others are
    for comparison. Across sessions: by the name of the query session."""
    positions: Float[np.ndarray, "n 3"] | None = None
    """Position of each frame in metres, z up. None across sessions and for labelled pairs without positions."""
    published: Sequence[tuple[str, ...]] = ()
    """Rows of the paper's numbers, if requested."""
    made_with: Mapping[str, Any] = field(default_factory=dict)
    """JSON values: the files, and the configuration, weights and distance of the descriptors."""
    database: str | None = None
    """Name of the database session. None for one recording."""

    @property
    def results(self) -> Sequence[Result]:
        """Results of the evaluated method, one for each protocol and, across sessions, for each query session."""
        if self.database is None:
            return next(iter(self.methods.values()))
        return [result for results in self._by_protocol().values() for result in results]

    @cached_property
    def judged(self) -> Result | None:
        """First result of a protocol that accepts answers by a threshold, or None."""
        return next((result for result in self.results if result.answers is not None), None)

    @cached_property
    def worst(self) -> Sequence[FalsePositive]:
        """Up to `MOST_MISTAKES` false positives of `judged`, in order of descriptor distance."""
        result, positions, worst = self.judged, self.positions, list[FalsePositive]()
        if result is None or positions is None:
            return worst
        assert result.answers is not None and result.answer_distances is not None and result.decisions is not None
        wrong = np.flatnonzero(result.decisions == Decision.FALSE_POSITIVE)
        for query in wrong[np.argsort(result.answer_distances[wrong], kind="stable")].tolist():
            if len(worst) < MOST_MISTAKES and all(abs(query - other.query) >= MISTAKE_GAP for other in worst):
                answer = int(result.answers[query])
                apart_m = np.linalg.norm((positions[query] - positions[answer])[: result.dimensions])
                worst.append(FalsePositive(query, answer, float(apart_m), float(result.answer_distances[query])))
        return worst

    def _by_protocol(self) -> dict[str, tuple[Result, ...]]:
        """Return the results of all methods or query sessions by the protocol's name on the command line."""
        names = {protocol.title: name for name, protocol in PROTOCOLS.items()}
        return {names[results[0].name]: results for results in zip(*self.methods.values(), strict=True)}

    def table(self) -> report.TextTable:
        """Return the table of all scores: methods side by side, or the query sessions, their mean and the paper's."""
        if self.database is None:
            return report.comparison(self.methods)
        header = ("", *map(printable, self.methods), "mean")
        rows = []
        for name, results in self._by_protocol().items():
            scores = [*(result.score for result in results), report.mean_score(results)]
            rows.append((name, *map(report.format_score, scores)))
        return report.TextTable(header, [*rows, *self.published], header[1:], self.title)

    def published_tables(self) -> list[report.TextTable | str]:
        """Return the paper's numbers that `table` does not have, and the note on them. Empty if not requested."""
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
            beside = {"about": paper.TABLE_3_NOTE, "columns": self.table().header, "rows": self.published}
            published = {"published": beside} if self.published else {}
            return {**self.made_with, "database_session": self.database, "results": results, **published}
        return {
            **self.made_with,
            "results": report.to_json(self.results),
            "false_positives": [dataclasses.asdict(mistake) for mistake in self.worst],
            "compared": {name: report.to_json(results) for name, results in list(self.methods.items())[1:]},
            "published": self.published,
        }

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[report.TextTable | str]:
        alone = self.database is None
        yield report.results_table(self.results, title=self.title if alone else "")
        if alone and any(result.curve is not None for result in self.results):
            yield report.threshold_table(self.results)
        if not alone or len(self.methods) > 1:
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
      source: A file that `evaluation.inputs` can read, an opened input, or descriptors (n, d) as an array of
        numpy, of JAX or of any type that numpy converts.
      protocols: Names in `PROTOCOLS`. `all` selects every protocol that fits the source. An empty sequence selects
        the default protocols that fit, or every protocol that fits if no default does.
      positions: Positions (n, 3) of the frames in metres, z up. They replace the positions of `source`.
      times: Times (n,) of the frames in seconds. They replace the times of `source`.
      distance: Name of the distance between descriptors. By default the distance of `source`, or L2 for an array.
      published: Whether to add the numbers of the paper for the sequence.

    Raises:
      ValueError: If positions are missing, or if a protocol or an option does not fit the source.

    Example:
      print(sglpr_jax.evaluate("08.npz"))
    """
    clock = None if times is None else np.asarray(times, np.float64)
    options, trajectory = {"times": clock}, None
    if positions is not None:
        trajectory = Trajectory(np.asarray(positions, np.float64), clock, "positions given as an array", by_row=True)
    if isinstance(source, str | Path):
        path = Path(source)
        read = read_input(path, trajectory, sequence=path.stem, distance=distance)
        with naming(path):
            read = _with_options(read, **options)
        return evaluate_methods({path.stem: read}, protocols, published=published, file=path)
    if distance is not None:
        distance_function(distance)
    if isinstance(source, Input):
        if trajectory is not None:
            options |= {"positions": trajectory.positions, "pose_source": trajectory.source}
        source = _with_options(source, **options, distance=distance)
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


def _with_options(source: Input, **options: Any) -> Input:
    """Replace fields of the source by options that are not None. Raises ValueError if an option does not fit."""
    options = {name: value for name, value in options.items() if value is not None}
    for name in options:
        if not hasattr(source, name):
            raise ValueError(f"expected no {name} beside {_about(source)}, found {name}")
    return dataclasses.replace(source, **options)


def evaluate_methods(
    methods: Mapping[str, Input], protocols: Sequence[str] = (), *, published: bool = False, file: Path | None = None
) -> Evaluation:
    """Score several methods by the same protocols.

    Arguments:
      methods: Input of each method, by name. The first method is the evaluated one.
      protocols: Names in `PROTOCOLS`. Without names, or with `all`, they are chosen to fit the first method.
      published: Whether to add the numbers of the paper for the sequence.
      file: File of the first method.

    Raises:
      ValueError: If a method cannot be scored, or has other frames than the first. The message names the method.
    """
    source = next(iter(methods.values()))
    names = chosen_protocols(kind_of(source), protocols)
    results = {}
    for method, other in methods.items():
        with naming(method):
            check_agreement(source, other)
            results[method] = score(other, names)
    if isinstance(source, ScoredPairs):
        sequence, title = "scored pairs", f"{'pairs' if file is None else file.name}, {len(source.pairs)} pairs"
    else:
        sequence, title = source.sequence, f"sequence {printable(source.sequence)}, {len(source)} scans"
    made_with: dict[str, Any] = {} if file is None else {"file": str(file)}
    if isinstance(source, DescriptorFile):
        made_with |= {"config": source.config, "weights_hash": source.weights_hash, "distance": source.distance}
    return Evaluation(
        title=title,
        about=_about(source) if file is None else f"{file}: {_about(source)}",
        methods=results,
        positions=source.positions,
        published=paper.table_1_rows(sequence) if published else (),
        made_with=made_with,
    )


def _about(source: Input) -> str:
    """Describe the source and its distance."""
    if isinstance(source, ScoredPairs):
        return "scored pairs" + (" with labels" if source.labels is not None else "")
    if isinstance(source, TopK):
        return f"up to {source.nearest.shape[1]} retrieved frames for each of {len(source.queries)} queries"
    return f"descriptors of {source.descriptors.shape[1]} numbers, compared by {source.distance}"
