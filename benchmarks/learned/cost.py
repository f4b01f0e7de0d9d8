"""Time of a descriptor, its size, and the size of the network, for all contenders.

    taskset -c 0 python -m benchmarks.learned.cost sglpr paper-112@random:0 rinet@random:0 bevplace++@random:0 ring

Contenders take turns, so that other programs slow all of them. The time is that from a scan in memory to its
descriptor, one scan at a time: the image or graph is part of it. A product and a sum are two operations.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from benchmarks.learned.data import TEST, folders
from benchmarks.learned.entries import Entry, entry
from sglpr_jax.data.readers import open_recording
from sglpr_jax.data.recording import Record, Recording
from sglpr_jax.data.views import view
from sglpr_jax.files import write_json
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.learned import LEARNED
from sglpr_jax.methods.learned.describe import apply_network
from sglpr_jax.methods.learned.weights_file import example_inputs, random_variables, weight_count
from sglpr_jax.methods.method import ImageMethod, RecordMethod
from sglpr_jax.models.sglpr import describe, init
from sglpr_jax.models.shipped import shipped_weights
from sglpr_jax.models.weights_file import load

TOWN = "town-601"
DescribeRecord = Callable[[Record], np.ndarray]
"""Maps a scan to its descriptor."""


def main(
    entries: tyro.conf.Positional[tuple[str, ...]],
    *,
    data: Path = Path("build/learned"),
    runs: Path = Path("build/learned/runs"),
    out: Path = Path("build/learned/cost.json"),
    scans: int = 20,
) -> None:
    """Measure, and write one JSON file.

    Args:
        entries: contenders, as in `entries`.
        data: folder of the recordings.
        runs: folder of the runs.
        out: file to write.
        scans: number of scans that each contender describes.
    """
    recording = open_recording(next(one for one in folders(data, TEST) if one.name == TOWN), "00")
    contenders = [entry(name, runs) for name in entries]
    describers = {one.name: _describer(one, recording) for one in contenders}
    records = [recording.record(row) for row in range(scans + 1)]
    times, found = _milliseconds(describers, records), {}
    for one in contenders:
        numbers = np.asarray(describers[one.name](records[0])).size
        found[one.name] = {"ms": times[one.name], "numbers": numbers, "bytes": 4 * numbers, **_network(one)}
        print(one.name, json.dumps(found[one.name]), flush=True)
    write_json(out, found)


def _milliseconds(describers: Mapping[str, DescribeRecord], records: Sequence[Record]) -> dict[str, float]:
    """Return the median time of each contender. The first record, for which programs are compiled, does not count."""
    times: dict[str, list[float]] = {name: [] for name in describers}
    for record in records:
        for name, of_scan in describers.items():
            start = time.perf_counter()
            of_scan(record)
            times[name].append(1e3 * (time.perf_counter() - start))
    return {name: float(np.median(found[1:])) for name, found in times.items()}


def _describer(contender: Entry, recording: Recording) -> DescribeRecord:
    """Return a function from a scan to its descriptor."""
    method = contender.method(recording)
    if isinstance(method, RecordMethod):
        return lambda record: np.asarray(method.describe(method.prepare(record)[None]))
    if isinstance(method, ImageMethod):
        return lambda record: np.asarray(method.describe(_image(record, method)[None]))
    return lambda record: method.describe(record.upright_points, record.classes(20) if method.labels else None)


def _image(record: Record, method: ImageMethod) -> np.ndarray:
    return np.asarray(view(record, method.grid, image=method.image).image)


def _network(contender: Entry) -> Mapping[str, Any]:
    """Return the number of weights and the operations of one image, in GFLOP; nothing for a handcrafted method."""
    name = contender.name.split("@")[0]
    if name in LEARNED:
        method = LEARNED[name]
        variables, inputs = random_variables(method, seed=0), example_inputs(method)
        cost = apply_network.lower(variables, inputs, method=method).cost_analysis()
        return {"weights": weight_count(variables), "gflop": _gflop(cost)}
    if name in HANDCRAFTED:
        return {}
    params = load(name) if name in shipped_weights() else init(jax.random.key(0), preset=name)
    grid = params.config.grid
    cost = jax.jit(describe).lower(params, np.zeros((1, grid.height, grid.width), np.float32)).cost_analysis()
    return {"weights": sum(leaf.size for leaf in jax.tree.leaves(params)), "gflop": _gflop(cost)}


def _gflop(cost: Any) -> float:
    return float(cost["flops"]) / 1e9


if __name__ == "__main__":
    tyro.cli(main)
