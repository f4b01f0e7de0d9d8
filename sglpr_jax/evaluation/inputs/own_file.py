"""Descriptor files, as `bin/embed` writes them."""

from dataclasses import replace
from pathlib import Path

from sglpr_jax.data.formats.scan_poses import poses_at_scans, unturned
from sglpr_jax.data.formats.trajectory import Trajectory
from sglpr_jax.retrieval.descriptor_file import DescriptorFile


def read_own_file(path: Path, trajectory: Trajectory | None) -> DescriptorFile:
    """Read a descriptor file; a trajectory replaces its positions, and its times where these were given for the frames.

    A trajectory of all scans of the recording serves a file from which some were left out. One of other times is
    interpolated at those of the file (`poses_at_scans`); frames without a pose are left out. Raises ValueError where
    it does not fit, and where there are no positions.
    """
    file = DescriptorFile.load(path)
    if trajectory is not None:
        try:
            file = _placed(file, trajectory, path.name)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
    if file.positions is None:
        raise ValueError(f"{path}: expected positions to score against, found descriptors of scans without poses")
    return file


def _placed(file: DescriptorFile, trajectory: Trajectory, name: str) -> DescriptorFile:
    """The frames of a file that have a pose, at it."""
    poses, times = trajectory.positions, trajectory.times
    recorded = file.recorded
    if len(poses) == len(recorded) != len(file):
        poses, times = poses[recorded], None if times is None else times[recorded]
    stamps = None if trajectory.by_row else times
    found = poses_at_scans(
        trajectory.source, unturned(poses), stamps, file.times, scans=len(file), of=f"frame of {name}"
    )
    keeps_times = times is None or (file.times is not None and not trajectory.by_row)
    source = f"{trajectory.source}, {found.said}" if found.said else trajectory.source
    placed = replace(file if found.kept.all() else file.only(found.kept), pose_source=source)
    return replace(placed, positions=found.poses[:, :3, 3], times=placed.times if keeps_times else times)
