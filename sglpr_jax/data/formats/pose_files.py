"""Reads text files with one row of numbers per frame: poses and timestamps."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import TimeUnit
from sglpr_jax.data.formats.timed_poses import poses_of
from sglpr_jax.data.times import ADVICE, times_of
from sglpr_jax.data.warning import warn
from sglpr_jax.poses import ROTATION_TOLERANCE, are_rotations

CAMERA_FROM_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""Transform from LiDAR axes (x forward, y left, z up) to camera axes (x right, y down, z forward), same origin."""
FARTHEST_M = 1e8
"""Maximum absolute coordinate of a position, in metres."""


def read_poses(path: Path) -> Float[np.ndarray, "n 3 4"]:
    """Return the poses (n, 3, 4) of a file with 12 numbers a line: rotation and translation in metres, row-major.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If a line does not have 12 finite numbers or is not a pose. The message names the first one.
    """
    poses = read_rows(path, columns=12).reshape(-1, 3, 4)
    wrong = np.flatnonzero(~are_rotations(poses[:, :, :3]))
    if wrong.size:
        found = " ".join(f"{value:g}" for value in poses[wrong[0]].ravel())
        raise ValueError(f"{path}: expected a rotation and a translation in row {wrong[0] + 1}, found {found}")
    check_positions(path, poses[:, :, 3])
    return poses


def check_positions(path: Path, positions: Float[np.ndarray, "n 3"]) -> None:
    """Raise ValueError if a coordinate exceeds `FARTHEST_M`. The message names its row in `path`."""
    far = np.flatnonzero(np.abs(positions).max(axis=1, initial=0) > FARTHEST_M)
    if far.size:
        raise ValueError(
            f"{path}: expected positions in metres, up to {FARTHEST_M:g}, found {positions[far[0]].tolist()} in row "
            f"{far[0] + 1}"
        )


def check_quaternions(path: Path, quaternions: Float[np.ndarray, "n 4"]) -> None:
    """Raise ValueError if a quaternion qx qy qz qw does not have length 1. The message names its row in `path`."""
    with np.errstate(over="ignore"):  # the square of a damaged number may be infinite
        lengths = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(~(np.abs(lengths - 1) <= ROTATION_TOLERANCE))
    if wrong.size:
        found = " ".join(f"{value:g}" for value in quaternions[wrong[0]])
        raise ValueError(f"{path}: expected a rotation qx qy qz qw of length 1 in row {wrong[0] + 1}, found {found}")


def rotations_of(path: Path, quaternions: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3 3"]:
    """Convert quaternions qx qy qz qw to rotation matrices. Raises what `check_quaternions` raises."""
    from scipy.spatial.transform import Rotation  # imported here because the import is slow

    check_quaternions(path, quaternions)
    if not len(quaternions):
        return np.zeros((0, 3, 3))
    return Rotation.from_quat(quaternions).as_matrix().reshape(-1, 3, 3)


def read_times(path: Path, *, unit: TimeUnit = "auto") -> Float[np.ndarray, " n"] | None:
    """Return the times (n,) in seconds of a file with one number a line. Warns and returns None for row numbers.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If a line is not a finite number, or `times_of` fails. The message names the line or row.
    """
    times = times_of(read_rows(path, columns=1)[:, 0], source=path, unit=unit)
    if times is None:
        warn(f"{path}: expected times, found row numbers (0, 1, 2, ...), not used; {ADVICE}")
    return times


def read_tum(
    path: Path, *, time_unit: TimeUnit = "auto"
) -> tuple[Float[np.ndarray, "n 4 4"], Float[np.ndarray, " n"] | None]:
    """Read the poses of a TUM file (`time x y z qx qy qz qw`), and their times in seconds or None (`times_of`).

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If a line is invalid. The message names the line or row.
    """
    rows = read_rows(path, columns=8)
    times = times_of(rows[:, 0], source=path, unit=time_unit)
    check_positions(path, rows[:, 1:4])
    return poses_of(rows[:, 1:4], rotations_of(path, rows[:, 4:])), times


def read_kitti(path: Path, *, camera: bool = True) -> Float[np.ndarray, "n 4 4"]:
    """Read poses with z up from 12 numbers a line, in KITTI's camera axes or, with `camera=False`, with z up.

    Raises the errors of `read_poses`.
    """
    rows = read_poses(path)
    poses = poses_of(rows[:, :, 3], rows[:, :, :3])
    return CAMERA_FROM_LIDAR.T @ poses @ CAMERA_FROM_LIDAR if camera else poses


def rows_of(ids: Sequence[str], *, rows: int, path: Path) -> list[int]:
    """Return the row of each frame in a file. Frame "000052" is row 52.

    Arguments:
      ids: Names of the frames.
      rows: Number of rows in the file.
      path: Path of the file, for messages.

    Raises:
      ValueError: If an id is not a number, or the file has too few rows.
    """
    strange = [name for name in ids if not name.isdecimal()]
    if strange:
        raise ValueError(f"{path}: expected frames named by their row, such as 000052, found {strange[0]!r}")
    numbers = [int(name) for name in ids]
    if max(numbers, default=-1) >= rows:
        raise ValueError(f"{path}: expected at least {max(numbers) + 1} rows (frame {max(numbers)}), found {rows}")
    return numbers


def read_rows(
    path: Path, *, columns: int, header_lines: int = 0, separator: str | None = None
) -> Float[np.ndarray, "n {columns}"]:
    """Return the numbers (n, columns) of a text file with one row a line. Lines that start with # are skipped.

    Arguments:
      path: Text file.
      columns: Number of columns.
      header_lines: Number of header lines to skip.
      separator: Separator of the columns. By default, white space.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If a line does not have `columns` finite numbers. The message names the first one.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: expected a file with {columns} numbers a line, one line per frame, found none"
        )
    lines = path.read_text(errors="replace").rstrip().splitlines()
    numbers = [i for i, line in enumerate(lines) if i >= header_lines and not line.startswith("#")]
    values = np.empty((len(numbers), columns))
    for row, i in enumerate(numbers):
        values[row] = numbers_of(lines[i].split(separator), columns=columns, where=f"{path}, line {i + 1}")
    return values


def columns_of(path: Path) -> int:
    """Return the number of columns in the first line that is not empty or a comment, or 0 for an empty file."""
    lines = path.read_text(errors="replace").splitlines()
    return len(next((line.split() for line in lines if line.strip() and not line.startswith("#")), []))


def numbers_of(words: Sequence[str], *, columns: int, where: str) -> Float[np.ndarray, " {columns}"]:
    """Convert words to numbers. Raises ValueError, prefixed by `where`, unless they are `columns` finite numbers."""
    if len(words) != columns:
        raise ValueError(f"{where}: expected {columns} numbers, found {len(words)}")
    text = " ".join(words)
    try:
        values = np.array(words, dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"{where}: expected numbers, found {text!r:.200}") from error
    if "_" in text or not text.isascii():  # Python parses 1_0 as 10
        raise ValueError(f"{where}: expected numbers, found {text!r:.200}")
    finite = np.isfinite(values)
    if not finite.all():
        raise ValueError(f"{where}: expected finite numbers, found {words[int(finite.argmin())]!r:.40}")
    return values
