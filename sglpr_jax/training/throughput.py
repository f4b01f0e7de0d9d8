"""How fast a run was, from its metrics."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True)
class Throughput:
    """Steps a second, and the share of the time in which the device waited for data; scores and compilation apart."""

    steps_per_second: float
    data_wait: float


def throughput(lines: Sequence[dict[str, Any]]) -> Throughput | None:
    """The throughput over all lines but the first, in which the step is compiled; None where there is only that."""
    timed = [line for line in lines if "steps_per_second" in line]
    if len(timed) < 2:
        return None
    steps = np.diff([line["step"] for line in timed])
    seconds = steps / [line["steps_per_second"] for line in timed[1:]]
    waited = seconds * [line["data_wait"] for line in timed[1:]]
    return Throughput(float(steps.sum() / seconds.sum()), float(waited.sum() / seconds.sum()))
