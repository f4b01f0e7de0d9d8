"""All distances of a recording in itself: seconds of each distance for as many frames as KITTI's 00 has.

    python -m benchmarks.speed.all_pairs --data TOWN --seq 00

A recording that is shorter is repeated. Of a slow distance only the first queries are compared with all frames; the
whole is then as many times longer as it has more queries.
"""

import time
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

from sglpr_jax.data.readers import open_recording
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.names import NETWORK
from sglpr_jax.methods.registry import method_named
from sglpr_jax.retrieval.distances import distance_function
from sglpr_jax.retrieval.embed import embed

FEWEST_QUERIES = 64


def main(
    data: Path,
    *,
    seq: str | None = None,
    methods: tuple[str, ...] = (NETWORK, *HANDCRAFTED),
    frames: int = 4541,
    seconds: float = 10.0,
) -> None:
    """Time the distances.

    Args:
        data: a dataset; ssc needs labels in it.
        seq: which sequence; may be left out where there is only one.
        methods: whose distances; sglpr is the network.
        frames: how many descriptors are compared with each other.
        seconds: a distance that takes longer for so many queries is timed on no more.
    """
    recording = open_recording(data, seq)
    rows = Table("method", "distance", "queries timed", "seconds", "µs a pair", f"all {frames} x {frames}")
    for name in track(methods, "distances", console=Console(stderr=True)):
        file = embed(method_named(name, None, recording), recording)
        descriptors = np.resize(file.descriptors, (frames, file.descriptors.shape[1]))
        queries, took = timed(file.distance, descriptors, seconds)
        whole = took * frames / queries
        per_pair = f"{1e6 * took / queries / frames:.3f}"
        rows.add_row(name, file.distance, f"{queries}", f"{took:.2f}", per_pair, f"{whole:.1f} s")
    Console(width=120, highlight=False).print(rows)


def timed(distance: str, descriptors: np.ndarray, seconds: float) -> tuple[int, float]:
    """How many queries were compared with all descriptors, and the seconds that took, once it was compiled."""
    compare, queries, took = distance_function(distance), min(FEWEST_QUERIES, len(descriptors)), 0.0
    while True:
        for _ in range(2):
            start = time.perf_counter()
            compare(descriptors[:queries], descriptors)
            took = time.perf_counter() - start
        if took >= seconds or queries == len(descriptors):
            return queries, took
        queries = min(4 * queries, len(descriptors))


if __name__ == "__main__":
    tyro.cli(main)
