"""Measurements of a run as JSON lines, and its speed. Lines are appended, so an interrupted run loses none."""

import contextlib
import itertools
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sglpr_jax.files import parse_json, raising_write_error, write_text


class MetricsLog:
    """Append-only file of JSON lines. After a resume, lines of steps that will be repeated are removed.

    Raises OSError, with the name of the file, if a line cannot be written.
    """

    def __init__(self, path: Path, *, start_step: int = 0):
        earlier_lines = read_metrics(path) if path.exists() else []
        kept_lines = [json.dumps(line) + "\n" for line in earlier_lines if line["step"] <= start_step]
        write_text(path, "".join(kept_lines))
        self._path = path
        self._file = path.open("ab", buffering=0)  # unbuffered, so that closing has nothing left to write

    def append(self, step: int, values: Mapping[str, Any]) -> None:
        """Write the measurements of one step. Values that are not finite become null."""
        floats = {name: float(value) for name, value in values.items()}
        json_values = {name: value if math.isfinite(value) else None for name, value in floats.items()}
        unwritten = json.dumps({"step": step, **json_values}).encode() + b"\n"
        with raising_write_error(self._path):
            while unwritten:  # a nearly full disk may accept only a part
                unwritten = unwritten[self._file.write(unwritten) :]

    def sync(self) -> None:
        """Flush the lines to disk. Called before a checkpoint, which must not be ahead of the log."""
        with raising_write_error(self._path):
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a metrics file. A last line that was cut off by a crash is ignored.

    Raises ValueError, with the file and the line, if any other line is invalid.
    """
    *complete_texts, last_text = path.read_bytes().split(b"\n")
    lines = [_parse_line(text, source=f"{path}, line {i}") for i, text in enumerate(complete_texts, start=1)]
    with contextlib.suppress(ValueError):  # cut off, or empty after the last newline
        lines.append(_parse_line(last_text, source=path))
    for i, (previous, line) in enumerate(itertools.pairwise(lines), start=2):
        if line["step"] < previous["step"]:
            raise ValueError(f"{path}, line {i}: expected a step from {previous['step']} on, found {line['step']}")
    return lines


def _parse_line(text: bytes, *, source: Path | str) -> dict[str, Any]:
    """Return a line as a dictionary. Raises ValueError unless it has an integer `step` and numbers or nulls."""
    line = parse_json(text, source=source)
    has_step = isinstance(line, dict) and type(line.get("step")) is int
    if not has_step or not all(value is None or type(value) in (int, float) for value in line.values()):
        raise ValueError(f"{source}: expected a step and its measurements, found {text[:80].decode(errors='replace')}")
    return line


class Throughput(NamedTuple):
    """Speed of a run without scores and compilation."""

    steps_per_second: float
    data_wait: float
    """Fraction of the time spent waiting for data."""


def throughput(lines: Sequence[dict[str, Any]]) -> Throughput | None:
    """Return the mean throughput over the lines of a log that have `steps_per_second`, or None without such lines.

    The first line after a start or a resume has no speed, because the step is compiled then.
    """
    steps, seconds, waited_s = 0, 0.0, 0.0
    for previous, line in itertools.pairwise(lines):
        if "steps_per_second" in line:
            line_steps = line["step"] - previous["step"]
            line_seconds = line_steps / line["steps_per_second"]
            steps += line_steps
            seconds += line_seconds
            waited_s += line["data_wait"] * line_seconds
    return Throughput(steps / seconds, waited_s / seconds) if steps else None
