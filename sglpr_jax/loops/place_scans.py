"""Choice of the scans of a drive that become places of a map."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from sglpr_jax.loops.candidates import CandidateFinder


class PlaceScans:
    """Scans at least `spacing_m` from the last place. Bad and almost empty scans do not become places."""

    def __init__(self, finder: CandidateFinder, positions: Float[np.ndarray, "n 3"], spacing_m: float):
        self._finder, self._positions, self._spacing_m = finder, positions, spacing_m
        self.looked_at: list[int] = []
        """Rows of the recording that are frames of the finder."""
        self.frames: list[int] = []
        """Frames of the finder that are places."""
        self.rows: list[int] = []
        """Rows of the recording that are places."""
        self.done = 0
        """Number of processed rows."""

    def unseen(self) -> Iterator[int]:
        """Yields the rows that have to be read. The caller adds each to the finder before it takes the next one."""
        for row in range(len(self._positions)):
            self.done = row
            if self._is_far(row):
                frame = len(self.looked_at)
                if frame == len(self._finder):  # not seen by an earlier run
                    yield row
                if not self._finder.empty[frame]:
                    self.frames.append(frame)
                    self.rows.append(row)
                self.looked_at.append(row)
        self.done = len(self._positions)

    def _is_far(self, row: int) -> bool:
        """Whether a scan is far enough from the last place."""
        if not self.rows:
            return True
        return bool(np.linalg.norm(self._positions[row] - self._positions[self.rows[-1]]) >= self._spacing_m)
