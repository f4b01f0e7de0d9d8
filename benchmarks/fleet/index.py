"""An index of many places: time to build, bytes, time of a query, and recall against exact answers.

Half of the places are random directions, and half resemble those of simulated drives. Queries are revisits of places of
both halves, moved by half the noise between successive scans.
"""

import itertools
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

import sglpr_jax
from sglpr_jax.methods.pairwise import unit_length
from sglpr_jax.numpy_files import read_arrays
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.fleet_index import FleetIndex
from sglpr_jax.retrieval.parquet import place_rows
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import HDL64E

ROUTES = ("00", "02", "05", "06", "08")
"""Routes that are driven in every town."""
BLOCK = 50_000
"""Number of places that are drawn at a time. A block is a recording."""


def places(*, out: Path, towns: int = 2, scans: int = 300, weights: str = "sglpr") -> None:
    """Describe drives through simulated towns, one after the other along each route.

    Args:
        out: file (.npz) of the descriptors, an array for each drive.
        towns: number of towns, with seeds from 700 on.
        scans: scans of a drive.
        weights: shipped weights.
    """
    params = sglpr_jax.load(weights)
    drives = {}
    for seed in range(700, 700 + towns):
        for route in ROUTES:
            recording = simulate_recording(route, scans=scans, seed=seed, sensor=HDL64E)
            drives[f"{seed}-{route}"] = sglpr_jax.embed(params, recording).descriptors
            print(f"{seed}-{route}: {len(drives[f'{seed}-{route}'])} descriptors", flush=True)
    np.savez(out, **drives)


class Drives:
    """Draws places that resemble those of the drives in a file.

    A drawn place lies at a random fraction of the way between two successive scans. Noise moves it like the differences
    between successive scans: it has their covariance, times `spread` squared.
    """

    def __init__(self, path: Path, *, spread: float = 1.0):
        drives = read_arrays(path, expected="descriptors of drives (.npz)").values()
        self.first = np.concatenate([drive[:-1] for drive in drives])
        self.step = np.concatenate([np.diff(drive, axis=0) for drive in drives])
        self.spread = spread

    def near(
        self, places: Float32[np.ndarray, "n d"], rng: np.random.Generator, *, spread: float | None = None
    ) -> Float32[np.ndarray, "n d"]:
        """Descriptors of revisits of places: moved by noise."""
        rows = rng.integers(len(self.step), size=(4, len(places)))
        weights = rng.standard_normal((4, len(places), 1), dtype=np.float32) / 2
        noise = sum(weight * self.step[row] for weight, row in zip(weights, rows, strict=True))
        return unit_length(places + (self.spread if spread is None else spread) * noise)

    def draw(self, n: int, rng: np.random.Generator) -> Float32[np.ndarray, "n d"]:
        """Descriptors of `n` new places."""
        rows, share = rng.integers(len(self.first), size=n), rng.random((n, 1), dtype=np.float32)
        return self.near(self.first[rows] + share * self.step[rows], rng)


def random_places(n: int, width: int, rng: np.random.Generator) -> Float32[np.ndarray, "n d"]:
    """Random directions."""
    return unit_length(rng.standard_normal((n, width), dtype=np.float32))


class Asked(NamedTuple):
    """Queries, and the names of their exact nearest places."""

    kind: str
    queries: Float32[np.ndarray, "q d"]
    answers: list[list[str]]


def index(
    *,
    drives: Path,
    places: int = 100_000,
    probes: tuple[int, ...] = (64,),
    refine: tuple[int, ...] = (20,),
    queries: int = 100,
) -> None:
    """Fill an index, and compare its answers with exact ones.

    Args:
        drives: file of `fleet places`.
        places: number of places.
        probes: numbers of partitions that a query searches.
        refine: numbers of places that are compared exactly for each of the 10 answers.
        queries: number of queries in each half.
    """
    drawn = Drives(drives)
    with tempfile.TemporaryDirectory() as folder:
        fleet = FleetIndex(folder, weights_hash="drawn")
        _fill(fleet, drawn, places)
        size = sum(path.stat().st_size for path in Path(fleet.address).rglob("*") if path.is_file())
        print(f"{size / 1e9:.2f} GB, {size / places:.0f} bytes a place", flush=True)
        for asked, *how in itertools.product(_exact(drawn, places, queries), probes, refine):
            _report(fleet, asked, *how)


def _fill(fleet: FleetIndex, drives: Drives, places: int) -> None:
    """Add the places, a block as a recording. Without the search for existing places, which grows with the table."""
    from lancedb.index import IvfSq

    start = time.perf_counter()
    for number, block in enumerate(_blocks(drives, places)):
        ids = tuple(f"{row:06d}" for row in range(len(block)))
        file = DescriptorFile("drawn", ids, None, np.arange(len(block)) / 10, block, None, {}, "drawn")
        rows = place_rows(file, f"{number:06d}", site=f"site {number % 10}")
        fleet.add(rows) if fleet.table is None else fleet.table.add(rows)
    written = time.perf_counter()
    fleet.optimize(IvfSq(distance_type="l2", num_partitions=round(places**0.5), max_iterations=15))
    built = time.perf_counter()
    print(f"{len(fleet):,} places: written in {written - start:.1f} s, indexed in {built - written:.1f} s", flush=True)


def _blocks(drives: Drives, places: int) -> Iterator[Float32[np.ndarray, "n d"]]:
    """Draw the places, the same ones in each call."""
    for number in range(-(-places // BLOCK)):
        rng, n = np.random.default_rng(number), min(BLOCK, places - number * BLOCK)
        yield np.concatenate([random_places(n // 2, drives.first.shape[1], rng), drives.draw(n - n // 2, rng)])


def _exact(drives: Drives, places: int, n: int) -> list[Asked]:
    """Draw queries near places of the first block, and compute their 10 nearest places exactly."""
    rng, first = np.random.default_rng(10**6), next(_blocks(drives, places))
    rows = rng.permutation(len(first) // 2)[:n]
    queries = drives.near(np.concatenate([first[rows], first[len(first) // 2 :][rows]]), rng, spread=0.5)
    distance, names = np.full((2 * n, 10), np.inf), np.zeros((2 * n, 10), int)  # squared distances
    for number, block in enumerate(_blocks(drives, places)):
        rough_distance = 2 - 2 * queries @ block.T
        nearest = np.argpartition(rough_distance, 10, axis=1)[:, :10]
        distance = np.hstack([distance, np.square(queries[:, None] - block[nearest], dtype=float).sum(axis=2)])
        names = np.hstack([names, number * BLOCK + nearest])
        order = np.argsort(distance, axis=1)[:, :10]
        distance, names = (np.take_along_axis(table, order, axis=1) for table in (distance, names))
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
