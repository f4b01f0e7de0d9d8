"""Speed of a run, computed from its metrics."""

import dataclasses
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True)
class Throughput:
    """Speed of a run without scores and compilation: steps per second, and fraction of the time spent waiting for
    data."""

    steps_per_second: float
    data_wait: float


def throughput(lines: Sequence[dict[str, Any]]) -> Throughput | None:
    """Return the mean throughput over all lines of the log that state a speed, or None if no line states one.

    The first line after a start or a resume has no speed, because the step is compiled then. Logs of earlier versions
    have a speed on these lines: the very first line is skipped, but the first line after each resume is counted.
    """
    timed = [(line["step"] - before["step"], line) for before, line in pairwise(lines) if "steps_per_second" in line]
    if not timed:
        return None
    steps = np.array([made for made, _ in timed])
    seconds = steps / [line["steps_per_second"] for _, line in timed]
    waited = seconds * [line["data_wait"] for _, line in timed]
    return Throughput(float(steps.sum() / seconds.sum()), float(waited.sum() / seconds.sum()))
