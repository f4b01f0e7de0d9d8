"""Reader of descriptor files of `bin/embed`."""

from dataclasses import replace
from pathlib import Path

from sglpr_jax.data.formats.pose_files import Trajectory
from sglpr_jax.data.poses import poses_at_scans, poses_of
from sglpr_jax.files import naming
from sglpr_jax.retrieval.descriptor_file import DescriptorFile


def read_own_file(path: Path, trajectory: Trajectory | None) -> DescriptorFile:
    """Read a descriptor file, optionally with the positions of another trajectory.

    A trajectory replaces the positions of the file. Its times replace those of the file if the file has no times, or if
    they were given for the frames (`Trajectory.by_row`). If `bin/embed` skipped scans, the trajectory may have a pose
    for every scan of the recording. If the times of the trajectory and the file differ, positions are interpolated
    (`poses_at_scans`) and frames without a pose are dropped.

    Raises ValueError if the trajectory does not fit or if there are no positions.
    """
    file = DescriptorFile.load(path)
    if trajectory is not None:
        with naming(path):
            file = _placed(file, trajectory, path.name)
    if file.positions is None:
        raise ValueError(f"{path}: expected positions to score against, found descriptors of scans without poses")
    return file


def _placed(file: DescriptorFile, trajectory: Trajectory, name: str) -> DescriptorFile:
    """Return the frames of a file that have a pose, with the positions of the trajectory."""
    poses, times = trajectory.positions, trajectory.times
    recorded = file.recorded
    if len(poses) == len(recorded) != len(file):
        poses, times = poses[recorded], None if times is None else times[recorded]
    stamps = None if trajectory.by_row else times
    found = poses_at_scans(
        trajectory.source, poses_of(poses), stamps, file.times, scans=len(file), of=f"frame of {name}"
    )
    keeps_times = times is None or (file.times is not None and not trajectory.by_row)
    source = f"{trajectory.source}, {found.said}" if found.said else trajectory.source
    placed = replace(file if found.kept.all() else file.only(found.kept), pose_source=source)
    return replace(placed, positions=found.poses[:, :3, 3], times=placed.times if keeps_times else times)
