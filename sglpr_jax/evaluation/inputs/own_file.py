"""Descriptor files, as `bin/embed` writes them."""

from dataclasses import replace
from pathlib import Path

from sglpr_jax.data.formats.trajectory import Trajectory
from sglpr_jax.evaluation.inputs.positions import needed
from sglpr_jax.retrieval.descriptor_file import DescriptorFile


def read_own_file(path: Path, trajectory: Trajectory | None) -> DescriptorFile:
    """Read a descriptor file; a trajectory replaces its positions, and its times where it has any.

    Raises ValueError where there are no positions.
    """
    file = DescriptorFile.load(path)
    if trajectory is not None:
        found = needed(path, trajectory, rows=len(file))
        times = file.times if found.times is None else found.times
        file = replace(file, positions=found.positions, times=times, pose_source=found.source)
    if file.positions is None:
        raise ValueError(f"{path}: expected positions to score against, found descriptors of scans without poses")
    return file
