"""Time and size of a descriptor, for all contenders.

Contenders take turns, so that other programs slow all of them. The time is that from a scan in memory to its
descriptor, one scan at a time: the image or graph is part of it.
"""

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from benchmarks.learned.data import TEST, TOWN, folders
from benchmarks.learned.score import entry
from benchmarks.timing import clocked, in_turn
from sglpr_jax.data.readers import open_recording
from sglpr_jax.files import write_json


def cost(
    entries: tyro.conf.Positional[tuple[str, ...]],
    *,
    data: Path = Path("build/learned"),
    scans: int = 20,
) -> None:
    """Measure, and write cost.json in `data`. One core: under `taskset -c 0`.

    Args:
        entries: contenders, see `score.py`.
        data: folder of the recordings and of the runs.
        scans: number of scans that each contender describes.
    """
    recording = open_recording(next(folder for folder in folders(data, TEST) if folder.name == TOWN), "00")
    contenders = [entry(name, data) for name in entries]
    methods = [contender.method(recording) for contender in contenders]

    def describe_row(method: Any, row: int) -> np.ndarray:
        inputs = jax.tree.map(lambda value: np.asarray(value)[None], method.prepare(recording_scans[row], None))
        return np.asarray(method.describe(inputs))

    recording_scans, costs = [recording.scan(row) for row in range(scans + 1)], {}
    rows = [iter(range(scans + 1)) for _ in methods]
    jobs = [  # each run describes the next scan
        clocked(lambda method=method, next_rows=next_rows: describe_row(method, next(next_rows)))
        for method, next_rows in zip(methods, rows, strict=True)
    ]
    seconds = np.median(in_turn(jobs, repeats=scans), axis=0).tolist()
    for contender, method, taken in zip(contenders, methods, seconds, strict=True):
        costs[contender.name] = {"ms": 1e3 * taken, "bytes": 4 * describe_row(method, 0).size}
        print(contender.name, json.dumps(costs[contender.name]), flush=True)
    write_json(data / "cost.json", costs)
