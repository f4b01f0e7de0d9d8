"""Schema of stored files: names and types of their JSON values, and names, types and shapes of their arrays.

A valid checksum says only that a file is whole. Another program or version may have written it.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from sglpr_jax.fields import check_value


class Column(NamedTuple):
    """Expected type and shape of a stored array."""

    dtype: str
    shape: tuple[int | str, ...]
    """Length of each axis. Axes with the same name have the same length."""
    finite: bool = True
    """Whether NaN and infinity are invalid."""
    optional: bool = False
    """Whether the array may be missing."""


def check_about(about: Any, fields: Mapping[str, Any], *, format: str) -> None:
    """Raise ValueError if the parsed JSON `about` is no object with this "format", or if a field is missing or invalid.

    `fields` has the annotation of each required field, as in a configuration (`fields.check_value`).
    """
    found = about.get("format") if isinstance(about, dict) else about
    if found != format:
        raise ValueError(f"expected format {format!r}, found {found!r:.60}")
    for name, annotation in fields.items():
        if name not in about:
            raise ValueError(f"expected {', '.join(f'`{field}`' for field in fields)}, found no `{name}`")
        check_value(about[name], annotation, f"`{name}`")


def check_columns(arrays: Mapping[str, np.ndarray], columns: Mapping[str, Column], **sizes: int) -> None:
    """Check the arrays of a file by name. Arrays without a column are ignored.

    `sizes` are the known lengths of named axes. The first array with any other named axis defines its length.

    Raises ValueError, with the name of the array, if an array is missing, has another type or shape, or is not finite.
    """
    missing = [name for name, column in columns.items() if not column.optional and name not in arrays]
    if missing:
        raise ValueError(f"expected arrays {', '.join(columns)}, found no {', '.join(missing)}")
    for name, column in columns.items():
        if name in arrays:
            _check_column(name, arrays[name], column, sizes)


def _check_column(name: str, array: np.ndarray, column: Column, sizes: dict[str, int]) -> None:
    """Raise ValueError if an array does not fit its column. Adds unknown lengths of its named axes to `sizes`."""
    if array.ndim == len(column.shape):
        for axis, length in zip(column.shape, array.shape, strict=True):
            if isinstance(axis, str):
                sizes.setdefault(axis, length)
    expected = tuple(sizes.get(axis, axis) if isinstance(axis, str) else axis for axis in column.shape)
    if array.dtype != column.dtype or array.shape != expected:
        shape = ", ".join(map(str, expected))
        raise ValueError(f"expected {name} as {column.dtype} ({shape}), found {array.dtype} {array.shape}")
    if column.finite and array.dtype.kind == "f":
        rows = np.flatnonzero(~np.isfinite(array).all(axis=tuple(range(1, array.ndim))))
        if rows.size:
            raise ValueError(
                f"expected finite {name}, found NaN or infinity in {rows.size} rows, first in row {rows[0]}"
            )
