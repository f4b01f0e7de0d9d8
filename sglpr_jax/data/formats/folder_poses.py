"""Poses and timestamps of a plain folder of scans, from files beside the scans or named by the user."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import PoseFormat, TimeUnit
from sglpr_jax.data.formats.pose_files import read_times
from sglpr_jax.data.formats.scan_poses import poses_at_scans, unturned
from sglpr_jax.data.formats.trajectory import Trajectory, read_trajectory

POSE_FILES = ("poses.txt", "poses.csv", "poses.tum")
TIMES_FILE = "times.txt"


def folder_trajectory(
    root: Path,
    *,
    scans: int,
    poses: Path | None = None,
    pose_format: PoseFormat = "auto",
    times: Path | None = None,
    time_unit: TimeUnit = "auto",
) -> tuple[Float[np.ndarray, "n 3"] | None, Float[np.ndarray, " n"] | None, str | None]:
    """Read the positions and times of the scans in a plain folder.

    If the poses have other times than the scans, or another number of rows, they are interpolated (`poses_at_scans`).

    Arguments:
      root: Folder of the scans.
      scans: Number of scans.
      poses: Pose file. By default, the file of `POSE_FILES` beside the scans. In a file beside the scans, 12 numbers a
        line are poses of the LiDAR, z up.
      pose_format: Format of the pose file.
      times: File of timestamps. By default, `TIMES_FILE` beside the scans, or else the times of the poses.
      time_unit: Unit of the times in both files. With "auto", row numbers are not times (`times_of`).

    Returns:
      Positions in metres, times in seconds, and a description of the pose source. Each is `None` if unknown.

    Raises:
      FileNotFoundError: If `poses` or `times` does not exist.
      ValueError: If the folder has several pose files, a file is malformed, `times` has another number of rows, or a
        scan has no pose.
    """
    beside = [root / name for name in POSE_FILES if (root / name).is_file()]
    if poses is None and len(beside) > 1:
        raise ValueError(f"{root}: expected one pose file, found {', '.join(path.name for path in beside)}")
    path = poses or next(iter(beside), None)
    clock = times or (root / TIMES_FILE if (root / TIMES_FILE).is_file() else None)
    seconds = None
    if clock is not None:
        seconds = read_times(clock, unit=time_unit)
        _check_rows(clock, scans if seconds is None else len(seconds), scans)
    if path is None:
        return None, seconds, None
    twelve = "lidar" if poses is None else None
    found = read_trajectory(path, format=pose_format, time_unit=time_unit, twelve_numbers=twelve)
    positions, said = _at_scans(path, found, seconds, scans, of=f"scan of {root.resolve().name}")
    source = found.source if poses is not None else path.name
    return positions, found.times if seconds is None else seconds, f"{source}{said}"


def _at_scans(
    path: Path, trajectory: Trajectory, times: Float[np.ndarray, " n"] | None, scans: int, *, of: str
) -> tuple[Float[np.ndarray, "n 3"], str]:
    """Positions of all scans, and how they were matched if not row by row. Raises ValueError if a scan has no pose."""
    found = poses_at_scans(str(path), unturned(trajectory.positions), trajectory.times, times, scans=scans, of=of)
    if times is not None and not found.kept.all():
        late = times[~found.kept]
        raise ValueError(
            f"{path}: expected poses at the times of all {scans} scans, found none for {len(late)}, the first at "
            f"{late[0]:.1f} s; remove these scans, or pass the poses only to bin/evaluate, which skips them"
        )
    return found.poses[:, :3, 3], f", {found.said}" if found.said else ""


def _check_rows(path: Path, rows: int, scans: int) -> None:
    if rows != scans:
        raise ValueError(f"{path}: expected {scans} rows, one per scan, found {rows}")
