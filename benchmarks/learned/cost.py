"""Time of a descriptor, its size, and the size of the network, for all contenders.

Contenders take turns, so that other programs slow all of them. The time is that from a scan in memory to its
descriptor, one scan at a time: the image or graph is part of it. A product and a sum are two operations.
"""

import functools
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from benchmarks.learned.data import TEST, folders
from benchmarks.learned.score import Entry, entry
from benchmarks.timing import clocked, in_turn
from sglpr_jax.data.readers import open_recording
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.files import write_json
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.learned import LEARNED
from sglpr_jax.methods.learned.describe import apply_network
from sglpr_jax.methods.learned.weights_file import example_inputs, random_variables
from sglpr_jax.models.sglpr import describe, init
from sglpr_jax.models.shipped import shipped_weights
from sglpr_jax.models.weights_file import load

TOWN = "town-601"
DescribeRecord = Callable[[Scan], np.ndarray]
"""Maps a scan to its descriptor."""


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
    recording = open_recording(next(one for one in folders(data, TEST) if one.name == TOWN), "00")
    contenders = [entry(name, runs) for name in entries]
    describers = [_describer(one, recording) for one in contenders]
    records, found = [recording.scan(row) for row in range(scans + 1)], {}
    jobs = [clocked(functools.partial(_describe_next, of_scan, iter(records))) for of_scan in describers]
    seconds = np.median(in_turn(jobs, repeats=scans), axis=0).tolist()
    for one, of_scan, taken in zip(contenders, describers, seconds, strict=True):
        numbers = np.asarray(of_scan(records[0])).size
        found[one.name] = {"ms": 1e3 * taken, "numbers": numbers, "bytes": 4 * numbers, **_network(one)}
        print(one.name, json.dumps(found[one.name]), flush=True)
    write_json(out, found)


def _describe_next(of_scan: DescribeRecord, records: Iterator[Scan]) -> None:
    of_scan(next(records))


def _describer(contender: Entry, recording: Recording) -> DescribeRecord:
    """Return a function from a scan to its descriptor."""
    method = contender.method(recording)

    def of_scan(scan: Scan) -> np.ndarray:
        inputs = jax.tree.map(lambda one: np.asarray(one)[None], method.prepare(scan, None))
        return np.asarray(method.describe(inputs))

    return of_scan


def _network(contender: Entry) -> Mapping[str, Any]:
    """Return the number of weights and the operations of one image, in GFLOP; nothing for a handcrafted method."""
    name = contender.name.split("@")[0]
    if name in LEARNED:
        method = LEARNED[name]
        variables, inputs = random_variables(method, seed=0), example_inputs(method)
        cost = apply_network.lower(variables, inputs, method=method).cost_analysis()
        return {"weights": method.weights, "gflop": float(cost["flops"]) / 1e9}
    if name in HANDCRAFTED:
        return {}
    params = load(name) if name in shipped_weights() else init(jax.random.key(0), preset=name)
    grid = params.config.grid
    cost = jax.jit(describe).lower(params, np.zeros((1, grid.height, grid.width), np.float32)).cost_analysis()
    return {"weights": sum(leaf.size for leaf in jax.tree.leaves(params)), "gflop": float(cost["flops"]) / 1e9}
