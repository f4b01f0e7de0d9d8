"""Reads the JSON tables of nuScenes and PandaSet: lists of rows, each an object. Every error names the file."""

import json
from collections.abc import Container, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.pose_files import quaternion_poses
from sglpr_jax.files import in_short

Rows = Sequence[dict[str, Any]]


def read_table(path: Path, column: str = "", accepted: Container[Any] = ()) -> list[dict[str, Any]]:
    """Return the rows of a JSON table. If `column` is given, only rows whose value in that column is in `accepted`."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a table, found none")

    def drop_unwanted(row: dict[str, Any]) -> dict[str, Any] | None:
        return row if not column or row.get(column) in accepted else None

    try:
        # Rows are dropped while the file is parsed: some tables have millions of rows.
        rows = json.loads(path.read_bytes(), object_hook=drop_unwanted)
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{path}: expected a table in JSON, found invalid JSON ({in_short(error)})") from error
    if not isinstance(rows, list) or not all(isinstance(row, dict | None) for row in rows):
        raise ValueError(f"{path}: expected a list of rows, each an object, found something else")
    return [row for row in rows if row is not None]


def column_of(path: Path, rows: Rows, name: str) -> list[Any]:
    """Return the values of a column. Raises ValueError, with the file `path` of the rows, if a row lacks the column."""
    incomplete = next((row for row in rows if name not in row), None)
    if incomplete is not None:
        found = ", ".join(incomplete) or "nothing"
        raise ValueError(f"{path}: expected {name!r} in every row, found a row with {found}")
    return [row[name] for row in rows]


def texts_of(path: Path, rows: Rows, name: str) -> list[str]:
    """Return a column of names or tokens. Raises ValueError, with the file `path`, for other values and empty texts."""
    values = column_of(path, rows, name)
    for value in values:
        if not isinstance(value, str) or not value:
            raise ValueError(f"{path}: expected text as {name!r} in every row, found {value!r:.80}")
    return values


def vectors_of(path: Path, rows: Rows, name: str, axes: str) -> Float[np.ndarray, "n {len(axes)}"]:
    """Return a column of finite vectors. Each is a list in the order of `axes`, or an object by axis."""
    values = column_of(path, rows, name)
    try:
        lists = [[value[axis] for axis in axes] if isinstance(value, dict) else value for value in values]
        vectors = np.array(lists, np.float64).reshape(len(rows), len(axes))
    except (KeyError, ValueError, TypeError, OverflowError) as error:
        expected = f"numbers {', '.join(axes)} as {name!r}"
        raise ValueError(f"{path}: expected {expected}, found others ({in_short(error)})") from error
    if not np.isfinite(vectors).all():
        raise ValueError(f"{path}: expected finite numbers as {name!r}, found NaN or infinite ones")
    return vectors


def poses_in_table(path: Path, rows: Rows, *, position: str, rotation: str) -> Float[np.ndarray, "n 4 4"]:
    """Return poses from the columns `position` (x, y, z in metres) and `rotation` (quaternions w, x, y, z)."""
    wxyz = vectors_of(path, rows, rotation, "wxyz")
    return quaternion_poses(path, vectors_of(path, rows, position, "xyz"), wxyz[:, [1, 2, 3, 0]])  # to x, y, z, w
