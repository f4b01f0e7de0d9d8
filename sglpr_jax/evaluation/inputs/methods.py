"""The files of several methods on the same frames, to be compared."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from sglpr_jax.data.formats.trajectory import Trajectory
from sglpr_jax.evaluation.inputs import Input, read_input
from sglpr_jax.evaluation.protocols import ScoredPairs
from sglpr_jax.retrieval.descriptor_file import DescriptorFile


def read_methods(
    paths: Sequence[Path],
    *,
    poses: Trajectory | None = None,
    dataset: Trajectory | None = None,
    sequence: str | None = None,
    distance: str | None = None,
) -> dict[str, Input]:
    """Read the file of every method, by the name of the method: that of its file.

    `poses` replace those of every file; where they have no times, those of the first file that has some serve all.
    Files that have none of their own get those of the first file or, where that has none either, of the `dataset`.
    `distance` names how the descriptors of the first file, and of every .npy, are compared. Errors as of `read_input`.
    """
    methods: dict[str, Input] = {}
    for path in paths:
        trajectory = poses if path.suffix == ".npz" else _of_first(methods) or poses or dataset
        compared_by = distance if path == paths[0] or path.suffix == ".npy" else None
        name = sequence or path.stem
        methods[_name(path, paths)] = read_input(path, trajectory, sequence=name, distance=compared_by)
    return methods if poses is None else _timed(methods)


def _of_first(methods: Mapping[str, Input]) -> Trajectory | None:
    """Where and when the frames of the first method were taken, where its file says it by itself."""
    first = next(iter(methods.values()), None)
    if not isinstance(first, DescriptorFile) or first.positions is None:
        return None
    return Trajectory(first.positions, first.times, first.pose_source or first.sequence, by_row=True)


def _timed(methods: Mapping[str, Input]) -> dict[str, Input]:
    """Give the methods without times those of the first that has some: with the same poses they have as many rows."""
    retrieved = [method for method in methods.values() if not isinstance(method, ScoredPairs)]
    times = next((method.times for method in retrieved if method.times is not None), None)
    return {
        name: method if isinstance(method, ScoredPairs) or method.times is not None else replace(method, times=times)
        for name, method in methods.items()
    }


def _name(path: Path, others: Sequence[Path]) -> str:
    """Return the file's name without its ending, or its whole path where another has the same name."""
    return path.stem if sum(other.stem == path.stem for other in others) == 1 else str(path)
