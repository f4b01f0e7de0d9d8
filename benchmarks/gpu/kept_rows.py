"""A table in a JSON file that is written after each row: a program that is cut keeps what it has, and goes on there."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sglpr_jax.files import read_json, write_json

Row = dict[str, Any]


class KeptRows:
    """The rows of the table in `path`, those of earlier calls first; `about` is written beside them.

    Raises ValueError where the file that is there is no such table.
    """

    def __init__(self, path: Path, *, about: Mapping[str, Any]):
        self._path, self._about = path, about
        self.rows: list[Row] = _read(path) if path.exists() else []

    def find(self, key: Row) -> Row | None:
        """The row that says so of all that `key` names; None where there is none."""
        return next((row for row in self.rows if key.items() <= row.items()), None)

    def add(self, key: Row, measure: Callable[[], Row]) -> None:
        """Measure a row and write it, unless it is there. Raises WriteError where the file cannot be written."""
        if self.find(key) is None:
            self.rows.append({**key, **measure()})
            write_json(self._path, {"rows": self.rows, **self._about})


def _read(path: Path) -> list[Row]:
    found = read_json(path)
    rows = found.get("rows") if isinstance(found, dict) else None
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ValueError(f"{path}: expected a table with rows, found none; remove the file to measure all anew")
    return rows
