"""The positions that an input is scored on."""

from pathlib import Path

from sglpr_jax.data.formats.trajectory import Trajectory


def needed(path: Path, trajectory: Trajectory | None, *, rows: int | None = None) -> Trajectory:
    """Return the trajectory; ValueError where there is none, or it has not as many poses as `path` has rows."""
    if trajectory is None:
        raise ValueError(f"{path}: expected positions to score against (--poses, or --data with poses), found none")
    poses = len(trajectory.positions)
    if rows is not None and rows != poses:
        raise ValueError(
            f"{path}: expected {poses} descriptors, as many as {trajectory.source} has poses, found {rows}"
        )
    return trajectory
