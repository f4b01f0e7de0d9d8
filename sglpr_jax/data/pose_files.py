"""Text files with one row of numbers per frame: poses and times."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float


def read_poses(path: Path) -> Float[np.ndarray, "n 3 4"]:
    """Return the poses (n, 3, 4) of a file with 12 numbers a line: a rotation and a translation in metres, row by row.

    Raises FileNotFoundError, and ValueError naming the first line without 12 finite numbers.
    """
    return _read_rows(path, columns=12).reshape(-1, 3, 4)


def read_times(path: Path) -> Float[np.ndarray, " n"]:
    """Return the times (n,) in seconds of a file with one number a line.

    Raises FileNotFoundError, and ValueError naming the first line that is no finite number or runs backwards.
    """
    times = _read_rows(path, columns=1)[:, 0]
    backwards = np.flatnonzero(np.diff(times) < 0)
    if backwards.size:
        line = int(backwards[0]) + 2
        raise ValueError(f"{path}, line {line}: expected a time >= {times[line - 2]}, found {times[line - 1]}")
    return times


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


def _read_rows(path: Path, *, columns: int) -> Float[np.ndarray, "n columns"]:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected {columns} numbers a line, one line per frame")
    rows = [line.split() for line in path.read_text(errors="replace").rstrip().splitlines()]
    values = np.empty((len(rows), columns))
    for i, row in enumerate(rows):
        if len(row) != columns:
            raise ValueError(f"{path}, line {i + 1}: expected {columns} numbers, found {len(row)}")
        try:
            values[i] = row
        except ValueError as error:
            raise ValueError(f"{path}, line {i + 1}: expected numbers, found {' '.join(row)!r}") from error
    not_finite = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if not_finite.size:
        line = int(not_finite[0]) + 1
        raise ValueError(f"{path}, line {line}: expected finite numbers, found {' '.join(rows[line - 1])!r}")
    return values
