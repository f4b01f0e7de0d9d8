"""Scoring what methods say of a recording: one call, and a result that prints itself."""

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
from rich.table import Table

from sglpr_jax.data.formats.trajectory import Trajectory
from sglpr_jax.evaluation import report
from sglpr_jax.evaluation.false_positives import FalsePositive, worst_false_positives
from sglpr_jax.evaluation.inputs import Input, read_input
from sglpr_jax.evaluation.inputs.agreement import check_agreement
from sglpr_jax.evaluation.inputs.arrays import as_descriptors, as_trajectory
from sglpr_jax.evaluation.protocols import Result, ScoredPairs, TopK, kind_of, protocol_named, protocols_taking
from sglpr_jax.evaluation.protocols.choice import chosen_protocols
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.distances import distance_function


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation(report.PrintsItself):
    """The results of one method, and of those it is compared with, by the same protocols. Prints itself as tables."""

    title: str
    about: str
    """What was scored and how it is compared, in a line."""
    methods: Mapping[str, Sequence[Result]]
    """By the name of the method; the first is the one in question."""
    positions: Float[np.ndarray, "n 3"] | None
    """Metres, z up; None where pairs came with labels alone."""
    published: Sequence[tuple[str, ...]] = ()
    """`report.published_rows` of the sequence, where they were asked for."""
    made_with: Mapping[str, Any] = field(default_factory=dict)
    """The file, and the configuration, weights and distance of its descriptors, as JSON can hold them."""

    @property
    def results(self) -> Sequence[Result]:
        """Those of the method in question, one for each protocol."""
        return next(iter(self.methods.values()))

    @cached_property
    def judged(self) -> Result | None:
        """The first result that accepts answers by a threshold; None where there is none."""
        return next((result for result in self.results if result.answers is not None), None)

    @cached_property
    def worst(self) -> Sequence[FalsePositive]:
        """The worst false positives of `judged`."""
        if self.judged is None or self.positions is None:
            return []
        return worst_false_positives(self.judged, self.positions)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for `json.dump`."""
        others = list(self.methods.items())[1:]
        return {
            **self.made_with,
            "results": report.to_json(self.results),
            "false_positives": [dataclasses.asdict(mistake) for mistake in self.worst],
            "compared": {name: report.to_json(results) for name, results in others},
            "published": self.published,
        }

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table | str]:
        yield report.table(self.results, title=self.title)
        if len(self.methods) > 1:
            yield report.comparison(self.methods)
        if self.published:
            yield report.published_table(self.published)
            yield report.PUBLISHED_NOTE


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

    `source` is a file of any kind that `evaluation.inputs` reads, what it was read to, or descriptors (n, d) as an
    array of numpy, of JAX or of any kind that numpy understands.
    `protocols` are names in `PROTOCOLS`; none stands for the headlines that fit, `all` for all that do. `positions`
    (n, 3) (metres, z up) and `times` (n,) (seconds) are those of the frames, in place of any that `source` has;
    `distance` names how descriptors are compared (unless given, as `source` says; those of an array by L2). With
    `published` the paper's numbers for the sequence stand beside. Raises ValueError where positions are missing, and
    where a protocol or an option does not fit.

    Example:
      print(sglpr_jax.evaluate("08.npz"))
    """
    clock = None if times is None else np.asarray(times, np.float64)
    given = as_trajectory(None if positions is None else np.asarray(positions, np.float64), clock)
    if isinstance(source, str | Path):
        path = Path(source)
        read = read_input(path, given, sequence=path.stem, distance=distance)
        read = _with_options(read, where=f"{path}: ", times=clock)
        return evaluate_methods({path.stem: read}, protocols, published=published, file=path)
    if distance is not None:
        distance_function(distance)
    if isinstance(source, Input):
        poses = {} if given is None else {"positions": given.positions, "pose_source": given.source}
        source = _with_options(source, **poses, times=clock, distance=distance)
    else:
        source = _of_array(source, given, distance or "l2")
    return evaluate_methods({"descriptors": source}, protocols, published=published)


def _with_options(source: Input, *, where: str = "", **options: Any) -> Input:
    """Return the source with those options that are given in place of its own; ValueError where one does not fit."""
    given = {name: value for name, value in options.items() if value is not None}
    for name in given:
        if not hasattr(source, name):
            raise ValueError(f"{where}expected no {name} beside {_about(source, None)}, found {name}")
    try:
        return dataclasses.replace(source, **given)
    except ValueError as error:
        raise ValueError(f"{where}{error}") from error


def _of_array(rows: ArrayLike, trajectory: Trajectory | None, distance: str) -> DescriptorFile:
    """Return descriptors of no name; ValueError where they are no matrix or positions are missing."""
    rows = np.asarray(rows)
    if rows.ndim != 2:
        raise ValueError(f"expected a file, what was read from one or descriptors (n, d), found {rows.shape}")
    if trajectory is None:
        raise ValueError(f"expected positions of {len(rows)} frames beside their descriptors, found none")
    return as_descriptors(rows, trajectory, sequence="", method="", distance=distance)


def evaluate_methods(
    methods: Mapping[str, Input], protocols: Sequence[str] = (), *, published: bool = False, file: Path | None = None
) -> Evaluation:
    """Score several methods by the same protocols: those that fit the first one, where none is named or `all` are.

    `file` is what the first was read from. Raises ValueError, naming the method, where one cannot be scored or is of
    other frames than the first.
    """
    source = next(iter(methods.values()))
    chosen = chosen_protocols(source, protocols)
    results = {}
    for name, of_one in methods.items():
        try:
            check_agreement(source, of_one)
            results[name] = score(of_one, chosen_protocols(of_one, chosen))
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    return Evaluation(
        title=_title(source, file),
        about=_about(source, file),
        methods=results,
        positions=source.positions,
        published=report.published_rows(_sequence_of(source)) if published else (),
        made_with=_made_with(source, file),
    )


def score(source: Input, protocols: Sequence[str] = ()) -> list[Result]:
    """Return the result of each named protocol; none named: of the headlines that fit.

    Raises ValueError where there are no positions, or a name is no protocol that `source` can be scored by.
    """
    known = protocols_taking(kind_of(source))
    return [protocol_named(name, known)(source) for name in protocols or chosen_protocols(source, ())]


def _title(source: Input, file: Path | None) -> str:
    if isinstance(source, ScoredPairs):
        return f"{'pairs' if file is None else file.name}, {len(source.pairs)} pairs"
    return f"sequence {source.sequence}, {len(source)} scans"


def _sequence_of(source: Input) -> str:
    return "scored pairs" if isinstance(source, ScoredPairs) else source.sequence


def _about(source: Input, file: Path | None) -> str:
    """Say what the source holds and how it is compared."""
    where = "" if file is None else f"{file}: "
    if isinstance(source, ScoredPairs):
        return f"{where}scored pairs" + (" with labels" if source.labels is not None else "")
    if isinstance(source, TopK):
        return f"{where}up to {source.nearest.shape[1]} retrieved frames for each of {len(source.queries)} queries"
    return f"{where}descriptors of {source.descriptors.shape[1]} numbers, compared by {source.distance}"


def _made_with(source: Input, file: Path | None) -> dict[str, Any]:
    about: dict[str, Any] = {} if file is None else {"file": str(file)}
    if isinstance(source, DescriptorFile):
        about |= {"config": source.config, "weights_hash": source.weights_hash, "distance": source.distance}
    return about
