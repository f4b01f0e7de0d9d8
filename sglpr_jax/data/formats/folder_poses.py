"""Where the scans of a plain folder were taken: pose files beside them, or one that is named."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import PoseFormat
from sglpr_jax.data.formats.pose_files import read_times
from sglpr_jax.data.formats.trajectory import read_trajectory

POSE_FILES = ("poses.txt", "poses.csv", "poses.tum")
TIMES_FILE = "times.txt"


def folder_trajectory(
    root: Path, *, scans: int, poses: Path | None = None, pose_format: PoseFormat = "auto", times: Path | None = None
) -> tuple[Float[np.ndarray, "n 3"] | None, Float[np.ndarray, " n"] | None, str | None]:
    """Return the positions, the times and the pose source of the `scans` scans in `root`, each None where none tells.

    Positions are those of the file `poses`, or of the one of `POSE_FILES` beside the scans, where 12 numbers a line are
    poses of the LiDAR, z up. Times are those of the file `times`, else of `TIMES_FILE` beside the scans, else of the
    poses. Raises ValueError where there are two pose files, or one is malformed or has another number of rows than
    there are scans.
    """
    beside = [root / name for name in POSE_FILES if (root / name).is_file()]
    if poses is None and len(beside) > 1:
        raise ValueError(f"{root}: expected one pose file, found {', '.join(path.name for path in beside)}")
    path = poses or next(iter(beside), None)
    found = None
    if path is not None:
        found = read_trajectory(path, format=pose_format, twelve_numbers="lidar" if poses is None else None)
        _check_rows(path, len(found.positions), scans)
    clock = times or (root / TIMES_FILE if (root / TIMES_FILE).is_file() else None)
    seconds = None if found is None else found.times
    if clock is not None:
        seconds = read_times(clock)
        _check_rows(clock, len(seconds), scans)
    if found is None or path is None:
        return None, seconds, None
    return found.positions, seconds, found.source if poses is not None else path.name


def _check_rows(path: Path, rows: int, scans: int) -> None:
    if rows != scans:
        raise ValueError(f"{path}: expected {scans} rows, one per scan, found {rows}")
