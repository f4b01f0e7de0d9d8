"""File of the loops of a live map, one JSON object a line, which grows while the node runs."""

import os
from collections.abc import Sequence
from pathlib import Path

from sglpr_jax.files import parse_json, writing
from sglpr_jax.live.report import Report
from sglpr_jax.loops.closure import Loop
from sglpr_jax.pose_graph.files import loop_lines, write_loops_jsonl


class LoopLog:
    """Appends loops to a file that `read_loops_jsonl` reads."""

    def __init__(self, path: Path, report: Report):
        self.path, self._report = path, report
        self._file: int | None = None

    def restore(self, loops: Sequence[Loop]) -> list[Loop]:
        """Begin with these loops, and return those that the file of an earlier process lacks."""
        written = _pairs(self.path)
        missed = [loop for loop in loops if (loop.query, loop.match) not in written]
        if not self.path.is_file() or self.path.read_bytes() != loop_lines(loops).encode():
            if missed and written:
                self._report("log", f"{self.path}: {len(missed)} loops were added that the last process did not write")
            write_loops_jsonl(self.path, loops)
        with writing(self.path):
            self._file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        return missed

    def append(self, loops: Sequence[Loop]) -> None:
        """Add loops at the end of the file. They survive the end of the process. Raises WriteError."""
        if not loops:
            return
        assert self._file is not None
        content = loop_lines(loops).encode()
        with writing(self.path):
            os.write(self._file, content)

    def sync(self) -> None:
        """Wait until the disk has all loops. Raises WriteError."""
        if self._file is not None:
            with writing(self.path):
                os.fsync(self._file)

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            os.close(self._file)


def _pairs(path: Path) -> set[tuple[int, int]]:
    """Query and match of each whole line of a file. A line that is cut or damaged is left out."""
    found = set()
    for line in path.read_bytes().splitlines() if path.is_file() else ():
        try:
            value = parse_json(line, source=path)
            found.add((value["query"], value["match"]))
        except (ValueError, KeyError, TypeError):
            continue
    return found
