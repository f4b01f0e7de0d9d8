"""A query of the index among a million places, beside faiss's flat index: time and memory."""

import importlib.util
import os
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from benchmarks.timing import Contender, Job, in_turn, report, resident_mb
from sglpr_jax.retrieval.index import Index

BLOCK = 100_000
"""Places that are drawn and added at a time: nobody holds all of them twice."""
WIDTH, NEAREST = 256, 3
"""Numbers of a descriptor, and places asked for."""
Ask = Callable[[Float[np.ndarray, "1 d"]], np.ndarray]
"""Answers a query with the rows of the nearest places."""


def index(*, rows: int = 1_000_000, repeats: int = 21, threads: int = 1) -> None:
    """Time queries among random places, each contender in a process of its own.

    faiss (`pip install faiss-cpu`) is left out if it is not installed.

    Args:
        rows: places.
        repeats: how often they are timed against each other.
        threads: threads that each may use.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = str(threads)  # of the processes to come
    ours = Contender("Index", _job, _index, rows, threads=threads)
    (found, megabytes), _ = ours.run()
    print(f"Index: {megabytes:.0f} MB for {rows:,} places, {4e-6 * rows * WIDTH:.0f} MB of them float32")
    if importlib.util.find_spec("faiss") is None:
        print(f"{in_turn((ours,), repeats=repeats).mean() * 1e3:.1f} ms a query; faiss is not installed")
        return
    other = Contender("faiss", _job, _faiss, rows, threads=threads)
    (same, megabytes), _ = other.run()
    print(f"faiss: {megabytes:.0f} MB; {np.mean(same == found):.2%} of the answers are those of Index")
    both = zip(("Index", "faiss"), in_turn((ours, other), repeats=repeats).T, strict=True)
    report(f"{NEAREST} nearest of {rows:,}", *both, packages=("numpy", "faiss-cpu"), threads=threads)


def _job(build: Callable[[int], Ask], rows: int) -> Job:
    """Ask about the same descriptor again and again, near to a place that is there."""
    before = resident_mb()
    ask = build(rows)
    megabytes = resident_mb() - before
    asked = _places(0, min(BLOCK, rows))[:1] + np.float32(0.01)
    return lambda: (ask(asked), megabytes)


def _index(rows: int) -> Ask:
    index = Index.empty(WIDTH)
    for start in range(0, rows, BLOCK):
        index.add(_places(start, min(BLOCK, rows - start)))
    return lambda asked: index.query(asked, NEAREST).rows


def _faiss(rows: int) -> Ask:
    import faiss

    index = faiss.IndexFlatL2(WIDTH)
    for start in range(0, rows, BLOCK):
        index.add(_places(start, min(BLOCK, rows - start)))
    return lambda asked: index.search(asked, NEAREST)[1]


def _places(start: int, count: int) -> Float[np.ndarray, "n d"]:
    """The places from `start` on: random directions."""
    rows = np.random.default_rng(start).standard_normal((count, WIDTH), dtype=np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)
