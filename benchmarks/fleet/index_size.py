"""An index of many places: time to build, bytes, time of a query, and recall against exact answers.

    python -m benchmarks.fleet.places --out drives.npz
    python -m benchmarks.fleet.index_size --drives drives.npz --places 1000000

Half of the places are random directions, and half resemble those of simulated drives (`benchmarks.fleet.places`).
Queries are revisits of places of both halves, moved by half the noise between successive scans.
"""

import itertools
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import tyro
from jaxtyping import Float32

from benchmarks.fleet.places import Drives, random_places
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.fleet_index import FleetIndex
from sglpr_jax.retrieval.parquet import place_rows

BLOCK = 50_000
"""Number of places that are drawn at a time. A block is a recording."""
Kind = Literal["rq", "pq", "sq", "hnsw"]


class Asked(NamedTuple):
    """Queries, and the names of their exact nearest places."""

    kind: str
    queries: Float32[np.ndarray, "q d"]
    answers: list[list[str]]


def main(
    *,
    drives: Path,
    places: int = 100_000,
    index: Kind = "sq",
    partitions: int | None = None,
    probes: tuple[int, ...] = (64,),
    refine: tuple[int, ...] = (20,),
    queries: int = 100,
    folder: Path | None = None,
) -> None:
    """Fill an index, and compare its answers with exact ones.

    Args:
        drives: file of `benchmarks.fleet.places`.
        places: number of places.
        index: kind of LanceDB's index.
        partitions: number of partitions. None: the square root of the number of places.
        probes: numbers of partitions that a query searches.
        refine: numbers of places that are compared exactly for each of the 10 answers.
        queries: number of queries in each half.
        folder: folder of the table, which stays and is not filled twice. None: a temporary folder.
    """
    drawn = Drives(drives)
    with tempfile.TemporaryDirectory() as temporary:
        fleet = FleetIndex(folder or temporary, weights_hash="drawn")
        if fleet.table is None:
            _fill(fleet, drawn, places, _config(index, partitions or round(places**0.5)))
        size = sum(path.stat().st_size for path in Path(fleet.place).rglob("*") if path.is_file())
        print(f"{size / 1e9:.2f} GB, {size / places:.0f} bytes a place", flush=True)
        for asked, *how in itertools.product(exact(drawn, places, queries), probes, refine):
            _report(fleet, asked, *how)


def _fill(fleet: FleetIndex, drives: Drives, places: int, config: Any) -> None:
    start = time.perf_counter()
    for number, block in enumerate(blocks(drives, places)):
        add(fleet, number, block)
    written = time.perf_counter()
    fleet.optimize(config)
    built = time.perf_counter()
    print(f"{len(fleet):,} places: written in {written - start:.1f} s, indexed in {built - written:.1f} s", flush=True)


def blocks(drives: Drives, places: int) -> Iterator[Float32[np.ndarray, "n d"]]:
    """Draw the places, the same ones in each call."""
    for number in range(-(-places // BLOCK)):
        rng, n = np.random.default_rng(number), min(BLOCK, places - number * BLOCK)
        yield np.concatenate([random_places(n // 2, drives.first.shape[1], rng), drives.draw(n - n // 2, rng)])


def add(fleet: FleetIndex, number: int, block: Float32[np.ndarray, "n d"]) -> None:
    """Add a block as a recording. Without the search for existing places, which grows with the table."""
    ids = tuple(f"{row:06d}" for row in range(len(block)))
    file = DescriptorFile("drawn", ids, None, np.arange(len(block)) / 10, block, None, {}, "drawn")
    rows = place_rows(file, f"{number:06d}", site=f"site {number % 10}")
    fleet.add(rows) if fleet.table is None else fleet.table.add(rows)


def exact(drives: Drives, places: int, n: int) -> list[Asked]:
    """Draw queries near places of the first block, and compute their 10 nearest places exactly."""
    rng, first = np.random.default_rng(10**6), next(blocks(drives, places))
    rows = rng.permutation(len(first) // 2)[:n]
    queries = drives.near(np.concatenate([first[rows], first[len(first) // 2 :][rows]]), rng, spread=0.5)
    apart, names = np.full((2 * n, 10), np.inf), np.zeros((2 * n, 10), int)
    for number, block in enumerate(blocks(drives, places)):
        found = 2 - 2 * queries @ block.T
        near = np.argpartition(found, 10, axis=1)[:, :10]
        apart = np.hstack([apart, np.square(queries[:, None] - block[near], dtype=float).sum(axis=2)])
        names = np.hstack([names, number * BLOCK + near])
        order = np.argsort(apart, axis=1)[:, :10]
        apart, names = (np.take_along_axis(each, order, axis=1) for each in (apart, names))
    answers = [[f"{name // BLOCK:06d}/{name % BLOCK:06d}" for name in row] for row in names.tolist()]
    return [Asked("random", queries[:n], answers[:n]), Asked("drives", queries[n:], answers[n:])]


def _report(fleet: FleetIndex, asked: Asked, probes: int, refine: int) -> None:
    """Print the recall and the time of single queries."""
    for query in asked.queries[:10]:  # reads files for the first time
        fleet.query(query, 10, probes=probes, refine=refine)
    seconds, first, ten = [], 0, 0
    for query, answers in zip(asked.queries, asked.answers, strict=True):
        start = time.perf_counter()
        found = fleet.query(query, 10, probes=probes, refine=refine)["place"].to_pylist()
        seconds.append(time.perf_counter() - start)
        first += found[0] == answers[0]
        ten += len({*found} & {*answers})
    p50, p99 = np.percentile(seconds, [50, 99]) * 1e3
    n = len(asked.queries)
    print(
        f"{asked.kind}, probes {probes}, refine {refine}: recall@1 {first / n:.4f}, recall@10 {ten / n / 10:.4f}, "
        f"p50 {p50:.1f} ms, p99 {p99:.1f} ms",
        flush=True,
    )


def _config(kind: Kind, partitions: int) -> Any:
    from lancedb.index import HnswSq, IvfPq, IvfRq, IvfSq

    of = {"rq": IvfRq, "pq": IvfPq, "sq": IvfSq, "hnsw": HnswSq}[kind]
    return of(distance_type="l2", num_partitions=partitions, max_iterations=15)


if __name__ == "__main__":
    tyro.cli(main)
