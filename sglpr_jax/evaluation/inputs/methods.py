"""Reader of the files of several methods on the same frames."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from sglpr_jax.data.formats.pose_files import Trajectory
from sglpr_jax.evaluation.inputs import Input, read_input
from sglpr_jax.evaluation.protocols.source import ScoredPairs
from sglpr_jax.retrieval.descriptor_file import DescriptorFile


def read_methods(
    paths: Sequence[Path],
    *,
    poses: Trajectory | None = None,
    dataset: Trajectory | None = None,
    sequence: str | None = None,
    distance: str | None = None,
) -> dict[str, Input]:
    """Read the file of every method and return the inputs by method name, which is the name of the file.

    Arguments:
      paths: Files of the methods.
      poses: Positions that replace those of every file. If they have no times, the times of the first file with times
        are used for all files.
      dataset: Positions for files without positions, if the first file has no positions either.
      sequence: Name of the sequence. By default the name of each file.
      distance: Name of the distance between descriptors, for the first file and for every .npy file.

    Raises:
      FileNotFoundError: As `read_input`.
      ValueError: As `read_input`.
    """
    methods: dict[str, Input] = {}
    for path in paths:
        trajectory = poses if path.suffix == ".npz" else _of_first(methods) or poses or dataset
        compared_by = distance if path == paths[0] or path.suffix == ".npy" else None
        name = sequence or path.stem
        methods[_name(path, paths)] = read_input(path, trajectory, sequence=name, distance=compared_by)
    return methods if poses is None else _timed(methods)


def _of_first(methods: Mapping[str, Input]) -> Trajectory | None:
    """Return the positions and times in the file of the first method, or None if it has no positions."""
    first = next(iter(methods.values()), None)
    if not isinstance(first, DescriptorFile) or first.positions is None:
        return None
    return Trajectory(first.positions, first.times, first.pose_source or first.sequence, by_row=True)


def _timed(methods: Mapping[str, Input]) -> dict[str, Input]:
    """Give methods without times the times of the first method with times. All have the same poses."""
    retrieved = [method for method in methods.values() if not isinstance(method, ScoredPairs)]
    times = next((method.times for method in retrieved if method.times is not None), None)
    return {
        name: method if isinstance(method, ScoredPairs) or method.times is not None else replace(method, times=times)
        for name, method in methods.items()
    }


def _name(path: Path, others: Sequence[Path]) -> str:
    """Return the file name without suffix, or the whole path if another file has the same name."""
    return path.stem if sum(other.stem == path.stem for other in others) == 1 else str(path)
