"""For distances between all pairs of two sets of descriptors: blocks that bound the memory, and all shifts at once."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from jaxtyping import Float32

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

    The database is prepared by `prepare_database` where that is another function. So many blocks at once as there are
    `threads` (None: one for each core), where what compares keeps only one busy.
    """
    out = np.empty((len(queries), len(database)), np.float32)

    def fill(column: int) -> None:
        prepared = (prepare_database or prepare)(database[column : column + block])
        for row in range(0, len(queries), block):
            found = compare(prepare(queries[row : row + block]), prepared)
            out[row : row + block, column : column + block] = found

    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        list(pool.map(fill, range(0, len(database), block)))  # raises what a block has raised
    return out


def correlate(
    queries: Float32[np.ndarray, "q rings sectors"], database: Float32[np.ndarray, "n rings sectors"]
) -> Float32[np.ndarray, "q n sectors"]:
    """Return the sums over rings r and sectors j of queries[r, j] * database[r, j + shift], for all circular shifts."""
    spectra = (np.moveaxis(np.fft.rfft(scans), -1, 0) for scans in (queries, database))
    by_frequency = next(spectra).conj() @ next(spectra).swapaxes(1, 2)
    return np.fft.irfft(np.moveaxis(by_frequency, 0, -1), n=queries.shape[-1])
