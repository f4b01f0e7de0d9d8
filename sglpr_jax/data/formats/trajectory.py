"""Reads trajectories: the position of every frame, in common file formats.

- kitti: 12 numbers a line, camera frame (x right, y down, z forward), as in the poses of KITTI and SemanticKITTI.
- lidar: 12 numbers a line, z up. Poses of the sensor or the car.
- tum: t x y z qx qy qz qw, z up.
- csv: a header with the column names x, y, z and optionally t, time or timestamp (seconds). It may begin with #.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import PoseFormat, TimeUnit
from sglpr_jax.data.formats.pose_files import check_positions, columns_of, read_kitti, read_rows, read_times, read_tum
from sglpr_jax.data.times import times_of
from sglpr_jax.data.warning import warn
from sglpr_jax.fields import check_value

MOST_HEIGHT_M = 100.0
"""Maximum range of heights in metres. A larger range is accepted if both horizontal ranges exceed it."""
JUMP_M = 10.0
JUMP_STEPS = 8.0
"""A step between two scans is a jump if it exceeds `JUMP_M` metres and `JUMP_STEPS` times the median step."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Positions and times of the frames of a sequence."""

    positions: np.ndarray
    """Positions (n, 3) as float64, in metres, z up."""
    times: np.ndarray | None
    """Times (n,) as float64, in seconds, or None."""
    source: str
    """Description of the pose source."""
    by_row: bool = False
    """Whether row i belongs to frame i regardless of the times, because the times are those of the frames."""
    rotations: np.ndarray | None = None
    """Rotations (n, 3, 3) of the frames, or None for csv."""


TIME_COLUMNS = ("t", "time", "timestamp")
"""Names of the csv column with the times in seconds."""
TIME_COLUMNS_S = ("t_s", "time_s", "timestamp_s", "seconds")
"""Names with a unit, used if none of `TIME_COLUMNS` exists."""
KNOWN_CLOCKS = (*TIME_COLUMNS, *TIME_COLUMNS_S)


def read_trajectory(
    path: Path,
    *,
    format: PoseFormat = "auto",
    times: Path | None = None,
    time_unit: TimeUnit = "auto",
    twelve_numbers: Literal["kitti", "lidar"] | None = None,
) -> Trajectory:
    """Read a pose file with one row per frame. Warns if the heights look wrong.

    Arguments:
      path: Pose file.
      format: Format of the pose file. "auto" recognises csv by its ending and tum by its 8 numbers a line.
      times: File of timestamps, one number a line. They replace the times of the pose file.
      time_unit: Unit of the times in both files (`times_of`).
      twelve_numbers: Format of files with 12 numbers a line, for "auto". It cannot be detected, and horizontal
        distances depend on it.

    Raises:
      FileNotFoundError: If a file does not exist.
      ValueError: If a file is malformed or empty, the numbers of poses and times differ, or "auto" cannot determine the
        format.
    """
    check_value(format, PoseFormat, f"{path}, format")
    check_value(time_unit, TimeUnit, f"{path}, time_unit")
    unit = "s" if times is not None and time_unit == "auto" else time_unit  # times that are replaced are not judged
    trajectory = _read(path, _format_of(path, twelve_numbers) if format == "auto" else format, unit)
    if len(trajectory.positions) == 0:
        raise ValueError(f"{path}: expected at least one pose, found none")
    check_height(trajectory.positions, path=path)
    if times is None:
        return trajectory
    clock = read_times(times, unit=time_unit)
    if clock is not None and len(clock) != len(trajectory.positions):
        raise ValueError(f"{times}: expected {len(trajectory.positions)} times, one per pose, found {len(clock)}")
    return replace(trajectory, times=clock, by_row=True)


def check_height(positions: Float[np.ndarray, "n 3"], *, path: Path) -> None:
    """Warn if the heights range over more than `MOST_HEIGHT_M` and a horizontal range: the frame is probably wrong."""
    forward, left, up = np.ptp(positions, axis=0)
    if up > MOST_HEIGHT_M and up > min(forward, left):
        warn(
            f"{path}: expected z up, found heights over {up:.0f} m and {forward:.0f} x {left:.0f} m on the ground;"
            " are the poses in another frame (kitti: camera axes, lidar: z up)?"
        )


def check_order(positions: Float[np.ndarray, "n 3"], ids: Sequence[str], *, path: Path) -> None:
    """Warn if consecutive scans are much farther apart than most: the scans may have another order than the poses."""
    if len(positions) < 3:
        return
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    usual = float(np.median(steps))
    far = np.flatnonzero(steps > max(JUMP_M, JUMP_STEPS * usual))
    near = _nearest(positions)
    if not len(far) and usual <= max(JUMP_M, JUMP_STEPS * near):
        return
    worst = int(np.argmax(steps))
    warn(
        f"{path}: expected consecutive scans near each other, found {ids[worst]} and {ids[worst + 1]}"
        f" {steps[worst]:.0f} m apart ({len(far)} jumps; half of the steps are below {usual:.1f} m, the median distance"
        f" to the nearest other pose is {near:.1f} m); are the poses in the order of the scans?"
    )


def _nearest(positions: Float[np.ndarray, "n 3"]) -> float:
    """Median distance to the nearest other pose, in metres."""
    from scipy.spatial import KDTree  # imported here because the import is slow

    return float(np.median(KDTree(positions).query(positions, k=2)[0][:, 1]))


def _format_of(path: Path, twelve_numbers: str | None) -> str:
    """Return the format by the ending or the first line."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a pose file, found none")
    if path.suffix == ".csv":
        return "csv"
    columns = columns_of(path)
    if columns == 12 and twelve_numbers is not None:
        return twelve_numbers
    if columns == 12:
        raise ValueError(
            f"{path}: expected --pose-format kitti (camera frame: KITTI, SemanticKITTI) or lidar (z up) for poses of"
            " 12 numbers a line, found neither"
        )
    if columns != 8:
        raise ValueError(f"{path}: expected 12 numbers a line (kitti, lidar), 8 (tum) or a .csv, found {columns}")
    return "tum"


def _read(path: Path, format: str, unit: TimeUnit) -> Trajectory:
    if format == "csv":
        return _read_csv(path, unit)
    if format == "tum":
        poses, times = read_tum(path, time_unit=unit)
        return Trajectory(poses[:, :3, 3], times, _said(path, "TUM"), rotations=poses[:, :3, :3])
    camera = format == "kitti"
    poses = read_kitti(path, camera=camera)
    said = _said(path, "camera" if camera else "z up")
    return Trajectory(poses[:, :3, 3], None, said, rotations=poses[:, :3, :3])


def _read_csv(path: Path, unit: TimeUnit) -> Trajectory:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a pose file, found none")
    names, clock = _header(path)
    columns = dict(zip(names, read_rows(path, columns=len(names), header_lines=1, separator=",").T, strict=True))
    times = None if clock is None else times_of(columns[clock], source=path, unit=unit)
    positions = np.stack([columns[axis] for axis in "xyz"], axis=1)
    check_positions(path, positions)
    return Trajectory(positions, times, _said(path, "csv"))


def _header(path: Path) -> tuple[list[str], str | None]:
    """Return the column names of a csv file, and the name of the time column or None."""
    header = path.read_text(errors="replace").partition("\n")[0]
    names = [name.strip().lower() for name in header.removeprefix("#").split(",")]  # numpy.savetxt begins it with #
    clocks = [name for name in names if name in TIME_COLUMNS] or [name for name in names if name in TIME_COLUMNS_S]
    if not {"x", "y", "z"} <= set(names):
        raise ValueError(f"{path}: expected a header with x, y and z, found {header[:80]!r}")
    if len(set(names)) < len(names) or len(clocks) > 1:
        raise ValueError(
            f"{path}: expected every column once, and one of {', '.join(KNOWN_CLOCKS)}, found {header[:80]!r}"
        )
    unused = [name for name in names if ("time" in name or "stamp" in name) and name not in clocks]
    if unused:
        warn(f"{path}: expected seconds in one of {', '.join(KNOWN_CLOCKS)}, found {', '.join(unused)}, not used")
    return names, clocks[0] if clocks else None


def _said(path: Path, format: str) -> str:
    """Short description of the file for tables: the last two parts of its path, and the format."""
    return f"{Path(*path.parts[-2:])} ({format})"
