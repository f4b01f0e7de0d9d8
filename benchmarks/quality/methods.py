"""Handcrafted methods beside each other: scores, and time of a scan and of a pair."""

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from sglpr_jax.data.readers import open_recording
from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation.protocols.top1 import TOP1_F1MAX
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.names import NETWORK
from sglpr_jax.methods.registry import method_named
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.distances import distance_function
from sglpr_jax.retrieval.embed import embed
from sglpr_jax.revisits import revisits

ROTATION_SEED = 0
FEWEST_QUERIES, ENOUGH_S = 64, 10.0
"""Queries that are timed at first, and seconds after which no more are."""


class Score(NamedTuple):
    """Descriptors of a method, their score, and seconds."""

    file: DescriptorFile
    f1_max: float
    recall_at_1: float
    per_scan_s: float


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
    columns = ("F1max", "rotated", "Recall@1", "rotated", "ms / scan", "µs / pair", f"all {frames} x {frames}")
    title = f"{data.name} {recording.name}, {len(recording)} scans, {again.sum()} revisits"
    table = Table("method", "numbers", "distance", *columns, title=title)
    for name in track(methods, "baselines", console=Console(stderr=True)):
        raw, rotated = (_score(name, recording, seed) for seed in (None, ROTATION_SEED))
        per_pair_s = _pair_s(
            raw.file.distance, np.resize(raw.file.descriptors, (frames, raw.file.descriptors.shape[1]))
        )
        reached = (raw.f1_max, rotated.f1_max, raw.recall_at_1, rotated.recall_at_1)
        took = (f"{1e3 * raw.per_scan_s:.0f}", f"{1e6 * per_pair_s:.3f}", f"{per_pair_s * frames**2:.1f} s")
        about = (str(raw.file.descriptors.shape[1]), raw.file.distance)
        table.add_row(name, *about, *(f"{value:.3f}" for value in reached), *took)
    Console(width=140, highlight=False).print(table)


def _score(name: str, recording: Recording, seed: int | None) -> Score:
    """Describe the sequence, and score."""
    start = time.perf_counter()
    file = embed(method_named(name, ready_made=recording.has_images), recording, rotation_seed=seed)
    seconds = time.perf_counter() - start
    result = TOP1_F1MAX(file)
    return Score(file, result.score, result.recalls[1], seconds / len(file))


def _pair_s(distance: str, descriptors: np.ndarray) -> float:
    """Seconds of a distance, once it is compiled. A slow one is timed on few queries."""
    compare, queries, took = distance_function(distance), min(FEWEST_QUERIES, len(descriptors)), 0.0
    while True:
        for _ in range(2):
            start = time.perf_counter()
            compare(descriptors[:queries], descriptors)
            took = time.perf_counter() - start
        if took >= ENOUGH_S or queries == len(descriptors):
            return took / queries / len(descriptors)
        queries = min(4 * queries, len(descriptors))
