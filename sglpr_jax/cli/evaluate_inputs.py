"""What bin/evaluate is given: files of methods, poses, a dataset and a model."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sglpr_jax.cli.page_pictures import sequence_rows
from sglpr_jax.data import Drive, open_sequence
from sglpr_jax.data.trajectory import PoseFormat, Trajectory, read_trajectory
from sglpr_jax.evaluation.inputs import Input, read_input
from sglpr_jax.evaluation.inputs.choice import chosen_protocols
from sglpr_jax.evaluation.protocols import Result
from sglpr_jax.evaluation.report import evaluate
from sglpr_jax.models.params import load
from sglpr_jax.models.sglpr import Params


@dataclass(frozen=True)
class PoseOptions:
    """Where the frames were taken, as the command line says."""

    path: Path | None
    format: PoseFormat
    times: Path | None

    def read(self) -> Trajectory | None:
        """Read the pose file, if there is one; ValueError for times without it."""
        if self.path is not None:
            return read_trajectory(self.path, format=self.format, times=self.times)
        if self.times is not None:
            raise ValueError(f"{self.times}: expected --poses beside --times, found none")
        return None


def open_dataset(data: Path | None, seq: str | None, weights: str | None) -> tuple[Drive | None, Params | None]:
    """Open what the page shows pictures of; ValueError for weights without data."""
    if data is not None:
        return open_sequence(data, seq), None if weights is None else load(weights)
    if weights is not None:
        raise ValueError(f"{weights}: expected --data beside --weights, found none")
    return None, None


def read_methods(
    paths: Sequence[Path], poses: PoseOptions, *, sequence: Drive | None, seq: str | None, distance: str | None
) -> dict[str, Input]:
    """Read the file of every method, by its name; the poses of `sequence` serve files that have none of their own.

    Raises ValueError where the first file's frames are not those of `sequence`.
    """
    given, own = poses.read(), None
    if sequence is not None and sequence.positions is not None:
        own = Trajectory(sequence.positions, sequence.times, sequence.pose_source or sequence.name)
    methods = {}
    for path in paths:
        name = seq or (path.stem if sequence is None else sequence.name)
        trajectory = given or (None if path.suffix == ".npz" else own)
        compared_by = distance if path == paths[0] or path.suffix == ".npy" else None
        methods[_name(path, paths)] = read_input(path, trajectory, sequence=name, distance=compared_by)
    if sequence is not None:
        sequence_rows(sequence, next(iter(methods.values())))
    return methods


def score(methods: dict[str, Input], names: Sequence[str]) -> dict[str, list[Result]]:
    """Score every method by the protocols asked for; by those that fit the first where none is, or `all` are."""
    chosen = chosen_protocols(next(iter(methods.values())), names)
    results = {}
    for method, source in methods.items():
        try:
            results[method] = evaluate(source, chosen_protocols(source, chosen))
        except ValueError as error:
            raise ValueError(f"{method}: {error}") from error
    return results


def _name(path: Path, others: Sequence[Path]) -> str:
    """Return the file's name without its ending, or its whole path where another has the same name."""
    return path.stem if sum(other.stem == path.stem for other in others) == 1 else str(path)
