"""Trajectories from files: where every frame was taken, in the formats that tools write.

kitti   12 numbers a line, camera frame (x right, y down, z forward): KITTI's own poses and SemanticKITTI's
lidar   12 numbers a line, z up: poses of the sensor or the car
tum     t x y z qx qy qz qw, z up
csv     a header that names columns, x, y and z among them and perhaps t, time or timestamp (seconds); # may begin it
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import PoseFormat
from sglpr_jax.data.formats.pose_files import (
    check_positions,
    check_quaternions,
    check_times,
    columns_of,
    read_poses,
    read_rows,
    read_times,
)
from sglpr_jax.data.warning import warn
from sglpr_jax.fields import check_value
from sglpr_jax.poses import positions_from_camera

MOST_HEIGHT_M = 100.0
"""Over a drive; more is believed where it reaches farther still on the ground."""
JUMP_M = 10.0
JUMP_STEPS = 8.0
"""A step from scan to scan is a jump above so many metres, and above so many times the usual step."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Where and when the frames of a sequence were taken."""

    positions: np.ndarray
    """(n, 3) float64, metres, z up."""
    times: np.ndarray | None
    """(n,) float64 seconds, or None."""
    source: str
    """Which poses these are, in words."""
    by_row: bool = False
    """Whether row i is frame i whatever the times, which were given for the frames."""


TIME_COLUMNS = ("t", "time", "timestamp")
TIME_COLUMNS_S = ("t_s", "time_s", "timestamp_s", "seconds")
"""Names that say their unit, for files without one of `TIME_COLUMNS`."""
KNOWN_CLOCKS = (*TIME_COLUMNS, *TIME_COLUMNS_S)


def read_trajectory(
    path: Path,
    *,
    format: PoseFormat = "auto",
    times: Path | None = None,
    twelve_numbers: Literal["kitti", "lidar"] | None = None,
) -> Trajectory:
    """Read a pose file, one row per frame; a file of `times`, one number a line, replaces those of the pose file.

    "auto" knows csv by its ending and tum by its 8 numbers a line. It does not guess which frame 12 numbers are in,
    for horizontal distances depend on it, but may be told (`twelve_numbers`). Raises FileNotFoundError, and ValueError
    naming the file, what was expected and what was found.
    """
    check_value(format, PoseFormat, f"{path}, format")
    trajectory = READERS[_format_of(path, twelve_numbers) if format == "auto" else format](path)
    if len(trajectory.positions) == 0:
        raise ValueError(f"{path}: expected at least one pose, found none")
    check_height(trajectory.positions, path=path)
    if times is None:
        return trajectory
    clock = read_times(times)
    if len(clock) != len(trajectory.positions):
        raise ValueError(f"{times}: expected {len(trajectory.positions)} times, as many as poses, found {len(clock)}")
    return replace(trajectory, times=clock, by_row=True)


def check_height(positions: Float[np.ndarray, "n 3"], *, path: Path) -> None:
    """Warn of a height that runs as far as a road does: the poses are in another frame than they were read in."""
    forward, left, up = np.ptp(positions, axis=0)
    if up > MOST_HEIGHT_M and up > min(forward, left):
        warn(
            f"{path}: expected z up, found heights over {up:.0f} m and {forward:.0f} x {left:.0f} m on the ground;"
            " are these poses in another frame (kitti: the camera's, lidar: z up)?"
        )


def check_order(positions: Float[np.ndarray, "n 3"], ids: Sequence[str], *, path: Path) -> None:
    """Warn where consecutive scans are much farther apart than most: their order may not be that of the poses."""
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
        f"{path}: expected scans near the ones before them, found {ids[worst]} and {ids[worst + 1]} {steps[worst]:.0f}"
        f" m apart ({len(far)} jumps; half of the steps are below {usual:.1f} m, the nearest other pose is"
        f" {near:.1f} m away); are the poses in the order of the scans?"
    )


def _nearest(positions: Float[np.ndarray, "n 3"]) -> float:
    """How far the nearest other pose is, in the middle of all."""
    from scipy.spatial import KDTree  # takes longer than all else that opens a folder of scans

    return float(np.median(KDTree(positions).query(positions, k=2)[0][:, 1]))


def _format_of(path: Path, twelve_numbers: str | None) -> str:
    """Return the format that the ending or the first line tells."""
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


def _read_kitti(path: Path) -> Trajectory:
    return Trajectory(positions_from_camera(read_poses(path)), None, _said(path, "camera"))


def _read_lidar(path: Path) -> Trajectory:
    return Trajectory(read_poses(path)[:, :, 3], None, _said(path, "z up"))


def _read_tum(path: Path) -> Trajectory:
    rows = read_rows(path, columns=8)
    check_times(path, rows[:, 0])
    check_positions(path, rows[:, 1:4])
    check_quaternions(path, rows[:, 4:])
    return Trajectory(rows[:, 1:4], rows[:, 0], _said(path, "TUM"))


def _read_csv(path: Path) -> Trajectory:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a pose file, found none")
    names, clock = _header(path)
    columns = dict(zip(names, read_rows(path, columns=len(names), header_lines=1, separator=",").T, strict=True))
    times = None if clock is None else columns[clock]
    if times is not None:
        check_times(path, times)
    positions = np.stack([columns[axis] for axis in "xyz"], axis=1)
    check_positions(path, positions)
    return Trajectory(positions, times, _said(path, "csv"))


def _header(path: Path) -> tuple[list[str], str | None]:
    """Return the names of a csv's columns, and which one has the times; ValueError where they do not tell."""
    header = path.read_text(errors="replace").partition("\n")[0]
    names = [name.strip().lower() for name in header.removeprefix("#").split(",")]  # numpy.savetxt writes # before it
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
    """Name the file shortly: a table has no room for a whole path."""
    return f"{Path(*path.parts[-2:])} ({format})"


READERS = {"kitti": _read_kitti, "lidar": _read_lidar, "tum": _read_tum, "csv": _read_csv}
