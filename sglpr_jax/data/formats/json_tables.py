"""Reads tables in JSON: a list of rows. Each row is an object with the column names as keys."""

import json
from collections.abc import Container, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sglpr_jax.files import in_short


def table_rows(path: Path, column: str = "", among: Container[Any] = ()) -> list[dict[str, Any]]:
    """Return the rows of a table. With `column`, only the rows whose value in this column is in `among`.

    Other rows are dropped while the file is parsed, because some tables have millions of rows.

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file is not a list of rows.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a table, found none")

    def wanted(row: dict[str, Any]) -> dict[str, Any] | None:
        return row if not column or row.get(column) in among else None

    try:
        rows = json.loads(path.read_bytes(), object_hook=wanted)
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{path}: expected a table in JSON, found invalid JSON ({in_short(error)})") from error
    kept = [row for row in rows if row is not None] if isinstance(rows, list) else [rows]
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in kept):
        raise ValueError(f"{path}: expected a list of rows, each an object, found something else")
    return kept


def column_of(path: Path, rows: Sequence[dict[str, Any]], name: str) -> list[Any]:
    """Return the values of a column. Raises ValueError if a row does not have this column."""
    lacking = next((row for row in rows if name not in row), None)
    if lacking is not None:
        raise ValueError(f"{path}: expected {name!r} in every row, found a row with {', '.join(lacking) or 'nothing'}")
    return [row[name] for row in rows]


def texts_of(path: Path, rows: Sequence[dict[str, Any]], name: str) -> list[str]:
    """Return a column of names or tokens. Raises ValueError if a value is missing, empty or no text."""
    values = column_of(path, rows, name)
    strange = next((value for value in values if not isinstance(value, str) or not value), values)
    if strange is not values:
        raise ValueError(f"{path}: expected text as {name!r} in every row, found {strange!r:.80}")
    return values


def numbers_of(path: Path, rows: Sequence[dict[str, Any]], name: str, size: int) -> Float[np.ndarray, "n {size}"]:
    """Return a column with `size` finite numbers in each row. Raises ValueError if a value is malformed."""
    values = column_of(path, rows, name)
    try:
        numbers = np.array(values, np.float64).reshape(len(rows), size)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"{path}: expected {size} numbers as {name!r}, found others ({in_short(error)})") from error
    strange = ~np.isfinite(numbers).all(axis=1)
    if strange.any():
        raise ValueError(f"{path}: expected finite numbers as {name!r}, found {values[int(strange.argmax())]}")
    return numbers
