"""Sink that writes results as JSON lines, whose `type` is `frame` (`FrameStatus`) or `loop` (`LoopEdge`)."""

import json
import os
import sys
from pathlib import Path
from typing import IO, Any

import numpy as np

from sglpr_jax.files import append_whole, raising_write_error
from sglpr_jax.live.data_types import FrameStatus, LoopEdge, Report
from sglpr_jax.live.options import LiveOptions


class JsonLines:
    """Writes a line for each scan and each loop at once, into a file completely or not at all."""

    def __init__(self, file: IO[str]):
        """Take a file that is open for appending, or standard output."""
        self._file = file
        self._is_stored = file is not sys.stdout and file.seekable()  # not a pipe

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
        line = json.dumps({"type": kind, **values}) + "\n"
        if self._is_stored:
            descriptor = self._file.fileno()
            append_whole(descriptor, line.encode(), size=os.fstat(descriptor).st_size)
        else:
            print(line, end="", file=self._file, flush=True)


def _json_value(value: Any) -> Any:
    """Return an array as lists, and a float with six decimals or, from 1e6 (times since 1970), with all digits."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    return round(value, 6) if isinstance(value, float) and abs(value) < 1e6 else value


def open_sink(where: str, options: LiveOptions, report: Report) -> JsonLines:
    """Open standard output, or the file `where` for appending. Raises WriteError if the file cannot be written."""
    if not where:
        return JsonLines(sys.stdout)
    path = Path(where)
    with raising_write_error(path, path, *path.parents):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a", encoding="utf-8")
        if _ends_within_line(path):
            print(file=file, flush=True)
        return JsonLines(file)


def _ends_within_line(path: Path) -> bool:
    """Return whether a file ends without a line break, as after a loss of power."""
    if not path.is_file() or not path.stat().st_size:
        return False
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read() != b"\n"
