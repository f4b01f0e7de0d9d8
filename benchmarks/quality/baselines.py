"""Every baseline on one sequence, as recorded and with every scan turned by its own random angle: one table."""

import time
from pathlib import Path
from typing import NamedTuple

import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

from sglpr_jax.data.readers import open_recording
from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation.protocols.top1_f1max import top1_f1max
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.registry import handcrafted
from sglpr_jax.models.config import model_preset
from sglpr_jax.retrieval.embed import embed
from sglpr_jax.revisits import revisits

ROTATION_SEED = 0


class Score(NamedTuple):
    """What a method reached, how long a descriptor is, and what it took in seconds."""

    f1_max: float
    recall_at_1: float
    numbers: int
    per_scan_s: float
    per_pair_s: float


def main(data: Path, *, seq: str | None = None, methods: tuple[str, ...] = tuple(HANDCRAFTED)) -> None:
    """Score baselines by top-1 retrieval: 3 m / 20 m, the last 30 s excluded.

    Args:
        data: a dataset in KITTI's layout; ssc needs labels in it. In a town without revisits there is nothing to score.
        seq: which sequence; may be left out where there is only one.
        methods: which baselines, by their names in bin/embed.
    """
    sequence = open_recording(data, seq)
    scores = {}
    for name in track(methods, "baselines", console=Console(stderr=True)):
        raw, rotated = (score(name, sequence, seed) for seed in (None, ROTATION_SEED))
        scores[name] = raw, rotated
    Console(width=140, highlight=False).print(table(scores, title=f"{data.name} {sequence.name}, {describe(sequence)}"))


def describe(sequence: Recording) -> str:
    """How much the scores rest on."""
    if sequence.positions is None or not (found := revisits(sequence.positions, times=sequence.times)).any():
        raise SystemExit(f"expected positions with revisits to score against, found none in sequence {sequence.name}")
    return f"{len(sequence)} scans, {found.sum()} revisits"


def score(name: str, sequence: Recording, seed: int | None) -> Score:
    """Describe the sequence, and score; comparing the queries with the rest is what a pair takes."""
    start = time.perf_counter()
    file = embed(handcrafted(name, sequence, model_preset("sglpr").grid), sequence, rotation_seed=seed)
    described = time.perf_counter()
    result = top1_f1max(file)
    compared = time.perf_counter()
    pairs = result.counts["queries"] * len(file)
    per_scan_s, per_pair_s = (described - start) / len(file), (compared - described) / pairs
    return Score(result.score, result.recalls[1], file.descriptors.shape[1], per_scan_s, per_pair_s)


def table(scores: dict[str, tuple[Score, Score]], *, title: str) -> Table:
    """One row per method."""
    columns = ("F1max", "rotated", "Recall@1", "rotated", "ms / scan", "µs / pair")
    rows = Table("method", "input", "numbers", "distance", *columns, title=title)
    for name, (raw, rotated) in scores.items():
        reached = (raw.f1_max, rotated.f1_max, raw.recall_at_1, rotated.recall_at_1)
        took = (f"{1e3 * raw.per_scan_s:.0f}", f"{1e6 * raw.per_pair_s:.1f}")
        about = (HANDCRAFTED[name].takes, str(raw.numbers), HANDCRAFTED[name].distance_name)
        rows.add_row(name, *about, *(f"{value:.3f}" for value in reached), *took)
    return rows


if __name__ == "__main__":
    tyro.cli(main)
