"""A query of the index among a million places, beside faiss's flat index and LanceDB: time and memory.

    pip install -r benchmarks/speed/index.txt
    python -m benchmarks.speed.index

Each has a process of its own. Where faiss or LanceDB (extra fleet) is not installed it is left out, and said.
"""

import importlib.util
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float

from benchmarks.speed.ratio import Contender, Job, alternate, report
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.fleet_index import FleetIndex
from sglpr_jax.retrieval.index import Index
from sglpr_jax.retrieval.parquet import place_rows

BLOCK = 100_000
"""Places that are drawn and added at a time: nobody holds all of them twice."""
Ask = Callable[[Float[np.ndarray, "q d"], int], np.ndarray]
"""Answers queries with the rows of the nearest k."""


def main(
    *, rows: int = 1_000_000, width: int = 256, k: int = 3, queries: int = 1, repeats: int = 21, threads: int = 1
) -> None:
    """Time queries among random places.

    Args:
        rows: places.
        width: numbers of a descriptor.
        k: places asked for.
        queries: descriptors asked about at a time.
        repeats: how often they are timed against each other.
        threads: threads that each may use; LanceDB takes what it wants.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = str(threads)  # of the processes to come
    with tempfile.TemporaryDirectory() as folder:
        sizes = (rows, width, k, queries, Path(folder))
        ours = Contender("Index", job, _index, *sizes, threads=threads)
        others = {
            "faiss": Contender("faiss", job, _faiss, *sizes, threads=threads) if _there("faiss") else None,
            "FleetIndex": Contender("FleetIndex", job, _fleet, *sizes, threads=threads) if _there("lancedb") else None,
        }
        (found, megabytes), _ = ours.run()
        print(f"Index: {megabytes:.0f} MB for {rows:,} places, {4e-6 * rows * width:.0f} MB of them float32")
        for name, other in others.items():
            if other is None:
                print(
                    f"{name}: not installed "
                    "(faiss: pip install -r benchmarks/speed/index.txt; FleetIndex: the extra fleet)"
                )
                continue
            (same, megabytes), _ = other.run()
            print(f"{name}: {megabytes:.0f} MB; {np.mean(same == found):.2%} of the answers are those of Index")
            seconds = alternate((ours, other), repeats=repeats).T
            packages = ("numpy", "faiss-cpu" if name == "faiss" else "lancedb")
            title = f"{queries} queries, {k} nearest of {rows:,}"
            report(title, [(name, *seconds)], other=name, ours="Index", packages=packages, threads=threads)


def job(build: Callable[[int, int, Path], Ask], rows: int, width: int, k: int, queries: int, folder: Path) -> Job:
    """Ask about the same descriptors again and again, near to places that are there."""
    before = _resident()
    ask = build(rows, width, folder)
    megabytes = _resident() - before
    asked = _places(0, min(BLOCK, rows), width)[:queries] + np.float32(0.01)
    return lambda: (ask(asked, k), megabytes)


def _index(rows: int, width: int, folder: Path) -> Ask:
    index = Index.empty(width)
    for start in range(0, rows, BLOCK):
        index.add(_places(start, min(BLOCK, rows - start), width))
    return lambda asked, k: index.query(asked, k).rows


def _faiss(rows: int, width: int, folder: Path) -> Ask:
    import faiss

    index = faiss.IndexFlatL2(width)
    for start in range(0, rows, BLOCK):
        index.add(_places(start, min(BLOCK, rows - start), width))
    return lambda asked, k: index.search(asked, k)[1]


def _fleet(rows: int, width: int, folder: Path) -> Ask:
    index = FleetIndex(folder)
    for start in range(0, rows, BLOCK):
        places = _places(start, min(BLOCK, rows - start), width)
        ids = tuple(str(row) for row in range(start, start + len(places)))
        index.add(place_rows(DescriptorFile("", ids, None, None, places, None, {}, ""), "drawn"))
    return lambda asked, k: _rows(index.query(asked, k, probes=None)["place"].to_pylist()).reshape(len(asked), k)


def _rows(places: list[str]) -> np.ndarray:
    return np.array([int(place.rpartition("/")[2]) for place in places])


def _places(start: int, count: int, width: int) -> Float[np.ndarray, "n d"]:
    """The places from `start` on: random directions."""
    rows = np.random.default_rng(start).standard_normal((count, width), dtype=np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def _resident() -> float:
    """Megabytes that this process holds."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def _there(package: str) -> bool:
    return importlib.util.find_spec(package) is not None


if __name__ == "__main__":
    tyro.cli(main)
