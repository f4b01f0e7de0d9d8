"""Where the scans of a plain folder were taken: pose files beside them, or one that is named."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import PoseFormat
from sglpr_jax.data.formats.pose_files import read_times
from sglpr_jax.data.formats.scan_poses import poses_at_scans, unturned
from sglpr_jax.data.formats.trajectory import Trajectory, read_trajectory

POSE_FILES = ("poses.txt", "poses.csv", "poses.tum")
TIMES_FILE = "times.txt"


def folder_trajectory(
    root: Path, *, scans: int, poses: Path | None = None, pose_format: PoseFormat = "auto", times: Path | None = None
) -> tuple[Float[np.ndarray, "n 3"] | None, Float[np.ndarray, " n"] | None, str | None]:
    """Return the positions, the times and the pose source of the `scans` scans in `root`, each None where none tells.

    Positions are those of the file `poses`, or of the one of `POSE_FILES` beside the scans, where 12 numbers a line are
    poses of the LiDAR, z up. Times are those of the file `times`, else of `TIMES_FILE` beside the scans, else of the
    poses. Poses of more, fewer or other times are interpolated. Raises ValueError where there are two pose files, one
    is malformed, or the poses are not those of all scans.
    """
    beside = [root / name for name in POSE_FILES if (root / name).is_file()]
    if poses is None and len(beside) > 1:
        raise ValueError(f"{root}: expected one pose file, found {', '.join(path.name for path in beside)}")
    path = poses or next(iter(beside), None)
    clock = times or (root / TIMES_FILE if (root / TIMES_FILE).is_file() else None)
    seconds = None
    if clock is not None:
        seconds = read_times(clock)
        _check_rows(clock, len(seconds), scans)
    if path is None:
        return None, seconds, None
    found = read_trajectory(path, format=pose_format, twelve_numbers="lidar" if poses is None else None)
    positions, said = _at_scans(path, found, seconds, scans, of=f"scan of {root.resolve().name}")
    source = found.source if poses is not None else path.name
    return positions, found.times if seconds is None else seconds, f"{source}{said}"


def _at_scans(
    path: Path, trajectory: Trajectory, times: Float[np.ndarray, " n"] | None, scans: int, *, of: str
) -> tuple[Float[np.ndarray, "n 3"], str]:
    """The positions of all scans, and how they were found if not row by row; ValueError where one has none."""
    found = poses_at_scans(str(path), unturned(trajectory.positions), trajectory.times, times, scans=scans, of=of)
    if times is not None and not found.kept.all():
        late = times[~found.kept]
        raise ValueError(
            f"{path}: expected poses about the times of all {scans} scans, found none for {len(late)}, the first at "
            f"{late[0]:.1f} s; leave these scans out, or name the poses to bin/evaluate alone, which leaves them out"
        )
    return found.poses[:, :3, 3], f", {found.said}" if found.said else ""


def _check_rows(path: Path, rows: int, scans: int) -> None:
    if rows != scans:
        raise ValueError(f"{path}: expected {scans} rows, one per scan, found {rows}")
