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
from sglpr_jax.evaluation import report
from sglpr_jax.evaluation.inputs import Input, as_descriptors, check_agreement, read_input
from sglpr_jax.evaluation.protocols import PROTOCOLS, chosen_protocols
from sglpr_jax.evaluation.protocols.protocol import Decision, Result
from sglpr_jax.evaluation.protocols.source import ScoredPairs, TopK
from sglpr_jax.files import naming, printable
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.distances import distance_function

APART = 10
"""Minimum gap between the queries of two shown mistakes, in frames. Neighbouring frames make the same mistake."""
MOST_SHOWN = 6


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
        return [result for of_one in zip(*self.methods.values(), strict=True) for result in of_one]

    @cached_property
    def judged(self) -> Result | None:
        """First result of a protocol that accepts answers by a threshold, or None."""
        return next((result for result in self.results if result.answers is not None), None)

    @cached_property
    def worst(self) -> Sequence[FalsePositive]:
        """Up to `MOST_SHOWN` false positives of `judged`, in order of descriptor distance."""
        result, positions, worst = self.judged, self.positions, list[FalsePositive]()
        if result is None or positions is None:
            return worst
        assert result.answers is not None and result.answer_distances is not None and result.decisions is not None
        wrong = np.flatnonzero(result.decisions == Decision.FALSE_POSITIVE)
        for query in wrong[np.argsort(result.answer_distances[wrong], kind="stable")].tolist():
            if len(worst) < MOST_SHOWN and all(abs(query - other.query) >= APART for other in worst):
                answer = int(result.answers[query])
                apart = (positions[query] - positions[answer])[: result.dimensions]
                metres = float(np.linalg.norm(apart))
                worst.append(FalsePositive(query, answer, metres, float(result.answer_distances[query])))
        return worst

    def _by_protocol(self) -> dict[str, list[Result]]:
        """Return the results of all methods or query sessions by the protocol's name on the command line."""
        names = {protocol.title: name for name, protocol in PROTOCOLS.items()}
        return {names[of_one[0].name]: list(of_one) for of_one in zip(*self.methods.values(), strict=True)}

    def table(self) -> report.TextTable:
        """Return the table of all scores: methods side by side, or the query sessions, their mean and the paper's."""
        if self.database is None:
            return report.comparison(self.methods)
        header = ("", *map(printable, self.methods), "mean")
        each = {name: [*(one.score for one in of), report.mean_score(of)] for name, of in self._by_protocol().items()}
        rows = [(name, *map(report.format_score, scores)) for name, scores in each.items()]
        return report.TextTable(header, [*rows, *self.published], header[1:], self.title)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for `json.dump`."""
        if self.database is not None:
            results = {
                name: {
                    "mean": report.score_or_none(report.mean_score(of_one)),
                    "sessions": dict(zip(self.methods, report.to_json(of_one), strict=True)),
                }
                for name, of_one in self._by_protocol().items()
            }
            beside = {"about": report.SESSIONS_NOTE, "columns": self.table().header, "rows": self.published}
            published = {"published": beside} if self.published else {}
            return {**self.made_with, "database_session": self.database, "results": results, **published}
        others = list(self.methods.items())[1:]
        return {
            **self.made_with,
            "results": report.to_json(self.results),
            "false_positives": [dataclasses.asdict(mistake) for mistake in self.worst],
            "compared": {name: report.to_json(results) for name, results in others},
            "published": self.published,
        }

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[report.TextTable | str]:
        alone = self.database is None
        yield report.results_table(self.results, title=self.title if alone else "")
        if alone and any(result.curve is not None for result in self.results):
            yield report.threshold_table(self.results)
        if not alone or len(self.methods) > 1:
            yield self.table()
        if self.published:
            yield from (
                [report.published_table(self.published), report.PUBLISHED_NOTE] if alone else [report.SESSIONS_NOTE]
            )


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
    poses, given = {}, None
    if positions is not None:
        given = Trajectory(np.asarray(positions, np.float64), clock, "positions given as an array", by_row=True)
        poses = {"positions": given.positions, "pose_source": given.source}
    if isinstance(source, str | Path):
        path = Path(source)
        read = read_input(path, given, sequence=path.stem, distance=distance)
        read = _with_options(read, where=f"{path}: ", times=clock)
        return evaluate_methods({path.stem: read}, protocols, published=published, file=path)
    if distance is not None:
        distance_function(distance)
    if isinstance(source, Input):
        source = _with_options(source, **poses, times=clock, distance=distance)
    else:
        rows = np.asarray(source)
        if rows.ndim != 2:
            raise ValueError(
                f"expected a file, an opened input, or descriptors (n, d), found an array of shape {rows.shape}"
            )
        if given is None:
            raise ValueError(f"expected positions of {len(rows)} frames beside their descriptors, found none")
        source = as_descriptors(rows, given, sequence="", method="", distance=distance or "l2")
    return evaluate_methods({"descriptors": source}, protocols, published=published)


def _with_options(source: Input, *, where: str = "", **options: Any) -> Input:
    """Return the source with the given options in place of its own. Raises ValueError if an option does not fit."""
    given = {name: value for name, value in options.items() if value is not None}
    for name in given:
        if not hasattr(source, name):
            raise ValueError(f"{where}expected no {name} beside {_about(source)}, found {name}")
    try:
        return dataclasses.replace(source, **given)
    except ValueError as error:
        raise ValueError(f"{where}{error}") from error


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
    chosen = chosen_protocols(source, protocols)
    results = {}
    for name, of_one in methods.items():
        with naming(name):
            check_agreement(source, of_one)
            results[name] = score(of_one, chosen)
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
        published=report.published_rows(sequence) if published else (),
        made_with=made_with,
    )


def score(source: Input, protocols: Sequence[str] = ()) -> list[Result]:
    """Return the result of each named protocol (`chosen_protocols`). Raises ValueError if positions are missing."""
    return [PROTOCOLS[name](source) for name in chosen_protocols(source, protocols)]


def _about(source: Input) -> str:
    """Describe the source and its distance."""
    if isinstance(source, ScoredPairs):
        return "scored pairs" + (" with labels" if source.labels is not None else "")
    if isinstance(source, TopK):
        return f"up to {source.nearest.shape[1]} retrieved frames for each of {len(source.queries)} queries"
    return f"descriptors of {source.descriptors.shape[1]} numbers, compared by {source.distance}"
