"""Handcrafted methods beside each other: scores, and time of a scan and of a pair."""

import time
from pathlib import Path

import numpy as np

from benchmarks.table import Table
from sglpr_jax.data.readers import open_recording
from sglpr_jax.evaluation.protocols.top1 import TOP1_F1MAX
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.names import NETWORK
from sglpr_jax.methods.registry import method_named
from sglpr_jax.retrieval.distances import distance_function
from sglpr_jax.retrieval.embed import embed
from sglpr_jax.revisits import revisits

ROTATION_SEED = 0
FEWEST_QUERIES, ENOUGH_S = 64, 10.0
"""Queries that are timed at first, and seconds after which no more are."""


def baselines(
    data: Path, *, seq: str | None = None, methods: tuple[str, ...] = (NETWORK, *HANDCRAFTED), frames: int = 4541
) -> None:
    """Score methods by top-1 retrieval (3 m / 20 m, the last 30 s excluded), as recorded and with rotated scans.

    Beside them are the times of a description, of a distance, and of all distances of `frames` frames, for which a
    shorter recording is repeated.

    Args:
        data: a dataset in KITTI's layout with revisits; ssc needs labels in it.
        seq: which sequence; may be left out if there is only one.
        methods: their names in bin/embed; sglpr is the network.
        frames: how many descriptors are compared with each other. The default is the number of KITTI's 00.
    """
    recording = open_recording(data, seq)
    again = None if recording.positions is None else revisits(recording.positions, times=recording.times)
    if again is None or not again.any():
        raise SystemExit(f"expected positions with revisits in sequence {recording.name}, found none")
    print(f"{data.name} {recording.name}, {len(recording)} scans, {again.sum()} revisits")
    columns = ("F1max", "rotated", "Recall@1", "rotated", "ms / scan", "µs / pair", f"all {frames} x {frames}")
    table = Table("method", "numbers", "distance", *columns)
    for name in methods:
        start = time.perf_counter()
        files = [embed(method_named(name, ready_made=recording.has_images), recording)]
        per_scan_s = (time.perf_counter() - start) / len(recording)
        files.append(embed(method_named(name, ready_made=recording.has_images), recording, rotation_seed=ROTATION_SEED))
        results = [TOP1_F1MAX(file) for file in files]
        scores = (*(result.score for result in results), *(result.recalls[1] for result in results))
        distance, numbers = files[0].distance, files[0].descriptors.shape[1]
        per_pair_s = _pair_s(distance, np.resize(files[0].descriptors, (frames, numbers)))
        took = (f"{1e3 * per_scan_s:.0f}", f"{1e6 * per_pair_s:.3f}", f"{per_pair_s * frames**2:.1f} s")
        table.add(name, numbers, distance, *(f"{score:.3f}" for score in scores), *took)


def _pair_s(distance: str, descriptors: np.ndarray) -> float:
    """Seconds of a distance, once it is compiled. A slow one is timed on few queries."""
    compare, queries = distance_function(distance), min(FEWEST_QUERIES, len(descriptors))
    while True:
        for _ in range(2):
            start = time.perf_counter()
            compare(descriptors[:queries], descriptors)
            seconds = time.perf_counter() - start
        if seconds >= ENOUGH_S or queries == len(descriptors):
            return seconds / queries / len(descriptors)
        queries = min(4 * queries, len(descriptors))
