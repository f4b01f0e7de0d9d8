"""Paths for libraries that read as many bytes as a damaged file declares."""

import io
import os
from pathlib import Path
from typing import Any


class BoundedPath(type(Path())):
    """A path whose open file reads no more than it contains. Python allocates the memory for a read before it reads."""

    def open(self, *options: Any, **more: Any) -> Any:
        """Open the file. Options other than the mode "rb" open it without a bound."""
        if options == ("rb",) and not more:
            return _BoundedFile(io.FileIO(self, "rb"))
        return super().open(*options, **more)


class _BoundedFile(io.BufferedReader):
    def __init__(self, raw: io.FileIO):
        super().__init__(raw)
        self._size = os.fstat(raw.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or size < 0:
            return super().read(size)
        return super().read(min(size, max(self._size - self.tell(), 0)))
