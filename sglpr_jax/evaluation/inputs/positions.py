"""Check of the positions that an input needs."""

from pathlib import Path

from sglpr_jax.data.formats.pose_files import Trajectory


def needed(path: Path, trajectory: Trajectory | None, *, rows: int | None = None) -> Trajectory:
    """Return the trajectory. Raises ValueError if it is missing or if its number of poses is not `rows`."""
    if trajectory is None:
        raise ValueError(f"{path}: expected positions to score against (--poses, or --data with poses), found none")
    poses = len(trajectory.positions)
    if rows is not None and rows != poses:
        raise ValueError(
            f"{path}: expected {poses} descriptors, one for each pose of {trajectory.source}, found {rows}"
        )
    return trajectory
