"""Unit vectors, and distances between all pairs of two sets of descriptors, in blocks and for all shifts."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

Rows = Float32[np.ndarray, "rows d"]


def in_blocks(
    compare: Callable[[Any, Any], np.ndarray],
    queries: Float32[np.ndarray, "q d"],
    database: Float32[np.ndarray, "n d"],
    *,
    block: int,
    prepare: Callable[[Rows], Any] = lambda rows: rows,
    prepare_database: Callable[[Rows], Any] | None = None,
    threads: int | None = 1,
) -> Float32[np.ndarray, "q n"]:
    """Return `compare(prepare(queries), prepare(database))`, computed for at most `block` x `block` pairs at a time.

    `prepare_database` replaces `prepare` for the database. `threads` is the number of blocks at the same time (None:
    the number of cores), which helps if `compare` uses only one core.
    """
    out = np.empty((len(queries), len(database)), np.float32)

    def fill(column: int) -> None:
        prepared = (prepare_database or prepare)(database[column : column + block])
        for row in range(0, len(queries), block):
            found = compare(prepare(queries[row : row + block]), prepared)
            out[row : row + block, column : column + block] = found

    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        list(pool.map(fill, range(0, len(database), block)))  # raises the errors of the blocks
    return out


def correlate(
    queries: Float32[np.ndarray, "q rings sectors"], database: Float32[np.ndarray, "n rings sectors"]
) -> Float32[np.ndarray, "q n sectors"]:
    """Return the sums over rings r and sectors j of queries[r, j] * database[r, j + shift], for all circular shifts."""
    spectra = (np.moveaxis(np.fft.rfft(scans), -1, 0) for scans in (queries, database))
    by_frequency = next(spectra).conj() @ next(spectra).swapaxes(1, 2)
    return np.fft.irfft(np.moveaxis(by_frequency, 0, -1), n=queries.shape[-1])


def unit_length(vectors: Float[np.ndarray, "n d"]) -> Float32[np.ndarray, "n d"]:
    """Return each vector divided by its length. Zero vectors stay zero."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0).astype(np.float32)
