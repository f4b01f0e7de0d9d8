"""Sink that writes results as JSON lines, whose `type` is `frame` (`FrameStatus`) or `loop` (`LoopEdge`)."""

import json
import sys
from pathlib import Path
from typing import IO, Any

import numpy as np

from sglpr_jax.files import raising_write_error
from sglpr_jax.live.data_types import FrameStatus, LoopEdge, Report
from sglpr_jax.live.options import LiveOptions


class JsonLines:
    """Writes a line for each scan and each loop, and flushes it."""

    def __init__(self, file: IO[str]):
        self._file = file

    def frame(self, status: FrameStatus) -> None:
        self._write("frame", status)

    def loop(self, edge: LoopEdge) -> None:
        self._write("loop", edge)

    def close(self) -> None:
        """Close the file, unless it is standard output."""
        if self._file is not sys.stdout:
            self._file.close()

    def _write(self, kind: str, message: FrameStatus | LoopEdge) -> None:
        values = {name: _json_value(value) for name, value in message._asdict().items()}
        self._file.write(json.dumps({"type": kind, **values}) + "\n")
        self._file.flush()


def _json_value(value: Any) -> Any:
    """Return an array as lists, and a float with six decimals or, from 1e6 (times since 1970), with all digits."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    return round(value, 6) if isinstance(value, float) and abs(value) < 1e6 else value


def open_sink(where: str, options: LiveOptions, report: Report) -> JsonLines:
    """Open standard output, or the file `where` for appending. Raises WriteError if the file cannot be written."""
    if not where:
        return JsonLines(sys.stdout)
    with raising_write_error(Path(where)):
        return JsonLines(Path(where).open("a", encoding="utf-8"))
