"""An array whose rows are appended over time."""

import numpy as np
from jaxtyping import Bool, Shaped

FIRST_CAPACITY = 256
"""Capacity of an empty array, in rows."""


class GrowingArray:
    """Rows of one shape and type. The capacity doubles when it is reached, so that appending stays cheap."""

    def __init__(self, rows: Shaped[np.ndarray, "n ..."]):
        """Start with `rows`, which are not copied. An empty array states the shape and type of the rows."""
        self._storage, self._count = rows, len(rows)

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> Shaped[np.ndarray, "n ..."]:
        """All rows, as a view that is valid until rows are added."""
        return self._storage[: self._count]

    @property
    def nbytes(self) -> int:
        """Number of bytes of the whole capacity."""
        return self._storage.nbytes

    def append(self, row: object) -> None:
        """Add one row."""
        self._reserve(self._count + 1)
        self._storage[self._count] = row
        self._count += 1

    def extend(self, rows: Shaped[np.ndarray, "n ..."]) -> None:
        """Add several rows."""
        end = self._count + len(rows)
        self._reserve(end)
        self._storage[self._count : end] = rows
        self._count = end

    def keep(self, flags: Bool[np.ndarray, " n"]) -> None:
        """Remove the rows whose flag is False. The others stay in order."""
        remaining = self.rows[flags]
        self._storage[: len(remaining)] = remaining
        self._count = len(remaining)

    def _reserve(self, count: int) -> None:
        """Increase the capacity to at least `count` rows."""
        capacity = max(len(self._storage), FIRST_CAPACITY)
        while capacity < count:
            capacity *= 2
        if capacity > len(self._storage):
            storage = np.empty((capacity, *self._storage.shape[1:]), self._storage.dtype)
            storage[: self._count] = self.rows
            self._storage = storage
