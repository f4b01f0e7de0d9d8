"""An array whose rows are appended over time."""

import numpy as np
from jaxtyping import Bool, Shaped

FIRST_ROOM = 256
"""Number of rows that an empty array has capacity for."""


class GrowingArray:
    """Rows of one shape and type. The capacity doubles when it is reached, so that appending stays cheap."""

    def __init__(self, rows: Shaped[np.ndarray, "n ..."]):
        """Start with some rows or, to state shape and type, with none. They are not copied."""
        self._held, self._count = rows, len(rows)

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> Shaped[np.ndarray, "n ..."]:
        """All rows. This is a view and must not be changed."""
        return self._held[: self._count]

    @property
    def nbytes(self) -> int:
        """Number of bytes, with the spare capacity."""
        return self._held.nbytes

    def append(self, row: object) -> None:
        """Add one row."""
        self._make_room(self._count + 1)
        self._held[self._count] = row
        self._count += 1

    def extend(self, rows: Shaped[np.ndarray, "n ..."]) -> None:
        """Add several rows."""
        end = self._count + len(rows)
        self._make_room(end)
        self._held[self._count : end] = rows
        self._count = end

    def keep(self, flags: Bool[np.ndarray, " n"]) -> None:
        """Remove the rows without a flag. The others stay in order."""
        left = self.rows[flags]
        self._held[: len(left)] = left
        self._count = len(left)

    def _make_room(self, count: int) -> None:
        room = max(len(self._held), FIRST_ROOM)
        while room < count:
            room *= 2
        if room > len(self._held):
            grown = np.empty((room, *self._held.shape[1:]), self._held.dtype)
            grown[: self._count] = self.rows
            self._held = grown
