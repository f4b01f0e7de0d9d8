"""Time of a descriptor, its size, and the size of the network, for all contenders.

Contenders take turns, so that other programs slow all of them. The time is that from a scan in memory to its
descriptor, one scan at a time: the image or graph is part of it. A product and a sum are two operations.
"""

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from benchmarks.learned.data import TEST, TOWN, folders
from benchmarks.learned.score import Entry, entry
from benchmarks.timing import clocked, in_turn
from sglpr_jax.data.readers import open_recording
from sglpr_jax.files import write_json
from sglpr_jax.methods.learned.method import LearnedMethod
from sglpr_jax.methods.learned.trained import apply_network, example_inputs, random_variables
from sglpr_jax.models.sglpr import describe


def cost(
    entries: tyro.conf.Positional[tuple[str, ...]],
    *,
    data: Path = Path("build/learned"),
    runs: Path = Path("build/learned/runs"),
    out: Path = Path("build/learned/cost.json"),
    scans: int = 20,
) -> None:
    """Measure, and write one JSON file. One core: under `taskset -c 0`.

    Args:
        entries: contenders, see `score.py`.
        data: folder of the recordings.
        runs: folder of the runs.
        out: file to write.
        scans: number of scans that each contender describes.
    """
    recording = open_recording(next(folder for folder in folders(data, TEST) if folder.name == TOWN), "00")
    contenders = [entry(name, runs) for name in entries]
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
        numbers = describe_row(method, 0).size
        costs[contender.name] = {"ms": 1e3 * taken, "numbers": numbers, "bytes": 4 * numbers, **_network(contender)}
        print(contender.name, json.dumps(costs[contender.name]), flush=True)
    write_json(out, costs)


def _network(contender: Entry) -> dict[str, Any]:
    """Return the number of weights and the operations of one image, in GFLOP; nothing for a handcrafted method."""
    network = contender.network
    if network is None:
        return {}
    if isinstance(network, LearnedMethod):
        variables, inputs = random_variables(network, seed=0), example_inputs(network)
        lowered, weights = apply_network.lower(variables, inputs, method=network), network.weights
    else:
        grid, weights = network.config.grid, sum(leaf.size for leaf in jax.tree.leaves(network))
        lowered = jax.jit(describe).lower(network, np.zeros((1, grid.height, grid.width), np.float32))
    return {"weights": weights, "gflop": float(lowered.cost_analysis()["flops"]) / 1e9}
