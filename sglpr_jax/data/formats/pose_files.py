"""Text files with one row of numbers per frame: poses and times."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.poses import ROTATION_TOLERANCE, are_rotations

CAMERA_FROM_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""Camera x right, y down, z forward from LiDAR x forward, y left, z up; both at one place."""
FARTHEST_M = 1e8
LATEST_S = 1e11
"""Times beyond the year 5000 are milli-, micro- or nanoseconds."""


def read_poses(path: Path) -> Float[np.ndarray, "n 3 4"]:
    """Return the poses (n, 3, 4) of a file with 12 numbers a line: a rotation and a translation in metres, row by row.

    Raises FileNotFoundError, and ValueError naming the first line without 12 finite numbers, or the first row that is
    no rotation and translation.
    """
    poses = read_rows(path, columns=12).reshape(-1, 3, 4)
    wrong = np.flatnonzero(~are_rotations(poses[:, :, :3]))
    if wrong.size:
        found = " ".join(f"{value:g}" for value in poses[wrong[0]].ravel())
        raise ValueError(f"{path}: expected a rotation and a translation in row {wrong[0] + 1}, found {found}")
    check_positions(path, poses[:, :, 3])
    return poses


def check_positions(path: Path, positions: Float[np.ndarray, "n 3"]) -> None:
    """Raise ValueError naming the first row of `path` whose position is none on earth."""
    far = np.flatnonzero(np.abs(positions).max(axis=1, initial=0) > FARTHEST_M)
    if far.size:
        raise ValueError(
            f"{path}: expected positions in metres, up to {FARTHEST_M:g}, found {positions[far[0]].tolist()} in row "
            f"{far[0] + 1}"
        )


def check_quaternions(path: Path, quaternions: Float[np.ndarray, "n 4"]) -> None:
    """Raise ValueError naming the first row of `path` whose qx qy qz qw are no rotation."""
    wrong = np.flatnonzero(~(np.abs(np.linalg.norm(quaternions, axis=1) - 1) <= ROTATION_TOLERANCE))
    if wrong.size:
        found = " ".join(f"{value:g}" for value in quaternions[wrong[0]])
        raise ValueError(f"{path}: expected a rotation qx qy qz qw of length 1 in row {wrong[0] + 1}, found {found}")


def rotations_of(path: Path, quaternions: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3 3"]:
    """Return the rotations that qx qy qz qw stand for; ValueError naming the first row of `path` with none."""
    from scipy.spatial.transform import Rotation  # takes longer than all else that opens a folder of scans

    check_quaternions(path, quaternions)
    return Rotation.from_quat(quaternions).as_matrix().reshape(-1, 3, 3)


def read_times(path: Path) -> Float[np.ndarray, " n"]:
    """Return the times (n,) in seconds of a file with one number a line.

    Raises FileNotFoundError, and ValueError naming the first line that is no finite number or the first row whose time
    is smaller than the one before.
    """
    times = read_rows(path, columns=1)[:, 0]
    check_times(path, times)
    return times


def check_times(path: Path, times: Float[np.ndarray, " n"]) -> None:
    """Raise ValueError naming the first row of numbers in `path` whose time is smaller than the one before.

    Times that are no seconds are refused too: rules such as "30 s older" would mean something else.
    """
    late = np.flatnonzero(np.abs(times) > LATEST_S)
    if late.size:
        raise ValueError(f"{path}, row {late[0] + 1}: expected seconds, found {times[late[0]]:g}: a smaller unit?")
    backwards = np.flatnonzero(np.diff(times) < 0)
    if backwards.size:
        row = int(backwards[0]) + 2
        raise ValueError(f"{path}, row {row}: expected a time >= {times[row - 2]}, found {times[row - 1]}")


def rows_of(ids: Sequence[str], *, rows: int, path: Path) -> list[int]:
    """Return the row of each frame in `path`, a file with `rows` rows: frame "000052" is row 52.

    Raises ValueError where an id is no number, or the file has too few rows.
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
    """Return the numbers (n, columns) of a text file, one row a line after so many lines of header.

    Columns stand apart by `separator`; None: by white space. Lines that start with # say nothing. Raises
    FileNotFoundError, and ValueError naming the first line without as many finite numbers.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected {columns} numbers a line, one line per frame")
    lines = path.read_text(errors="replace").rstrip().splitlines()
    numbers = [i for i, line in enumerate(lines) if i >= header_lines and not line.startswith("#")]
    values = np.empty((len(numbers), columns))
    for row, i in enumerate(numbers):
        values[row] = numbers_of(lines[i].split(separator), columns=columns, where=f"{path}, line {i + 1}")
    return values


def columns_of(path: Path) -> int:
    """Return how many words the first line of a text file has that is no comment; 0 for none."""
    lines = path.read_text(errors="replace").splitlines()
    return len(next((line.split() for line in lines if line.strip() and not line.startswith("#")), []))


def numbers_of(words: Sequence[str], *, columns: int, where: str) -> Float[np.ndarray, " {columns}"]:
    """Return words as numbers; ValueError, which begins with `where`, unless there are `columns` finite ones."""
    if len(words) != columns:
        raise ValueError(f"{where}: expected {columns} numbers, found {len(words)}")
    text = " ".join(words)
    try:
        values = np.array(words, dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"{where}: expected numbers, found {text!r:.200}") from error
    if "_" in text or not text.isascii():  # Python takes 1_0 for 10
        raise ValueError(f"{where}: expected numbers, found {text!r:.200}")
    finite = np.isfinite(values)
    if not finite.all():
        raise ValueError(f"{where}: expected finite numbers, found {words[int(finite.argmin())]!r:.40}")
    return values
