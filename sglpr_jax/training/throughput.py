"""How fast a run was, from its metrics."""

import dataclasses
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True)
class Throughput:
    """Steps a second, and the share of the time in which the device waited for data; scores and compilation apart."""

    steps_per_second: float
    data_wait: float


def throughput(lines: Sequence[dict[str, Any]]) -> Throughput | None:
    """The throughput over all lines that say how fast they were; None where none does.

    The first line after each start does not: the step is compiled there. (Older logs say it; their first line is left
    out, those after a resume are not.)
    """
    timed = [(line["step"] - before["step"], line) for before, line in pairwise(lines) if "steps_per_second" in line]
    if not timed:
        return None
    steps = np.array([made for made, _ in timed])
    seconds = steps / [line["steps_per_second"] for _, line in timed]
    waited = seconds * [line["data_wait"] for _, line in timed]
    return Throughput(float(steps.sum() / seconds.sum()), float(waited.sum() / seconds.sum()))
