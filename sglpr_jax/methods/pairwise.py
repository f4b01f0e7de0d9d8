"""Distances and correlations between all pairs of two sets of descriptors, and unit vectors."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

Rows = Float32[np.ndarray, "rows d"]
BLOCK = 1024
"""Number of queries, and of database descriptors, in a block of L2 or cosine distances."""


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
    distances = np.empty((len(queries), len(database)), np.float32)

    def fill_columns(start: int) -> None:
        columns = slice(start, start + block)
        prepared_database = (prepare_database or prepare)(database[columns])
        for first_row in range(0, len(queries), block):
            rows = slice(first_row, first_row + block)
            distances[rows, columns] = compare(prepare(queries[rows]), prepared_database)

    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        list(pool.map(fill_columns, range(0, len(database), block)))  # `list` raises the errors of the threads
    return distances


def l2(queries: Float32[np.ndarray, "q d"], database: Float32[np.ndarray, "n d"]) -> Float32[np.ndarray, "q n"]:
    """Return the Euclidean distances |q - d|, from sums in float64, because the squares of similar vectors cancel."""

    def compare(queries, database):
        squares = np.sum(queries**2, axis=1)[:, None] + np.sum(database**2, axis=1)[None, :]
        return np.sqrt(np.maximum(squares - 2 * queries @ database.T, 0))

    return in_blocks(compare, queries, database, block=BLOCK, prepare=lambda rows: rows.astype(np.float64))


def cosine(queries: Float32[np.ndarray, "q d"], database: Float32[np.ndarray, "n d"]) -> Float32[np.ndarray, "q n"]:
    """Return the distances 1 - q . d / (|q| |d|), from 0 to 2. The distance of a zero vector from any other is 1."""

    def unit(rows):
        lengths = np.linalg.norm(rows.astype(np.float64), axis=1, keepdims=True)
        return np.divide(rows, lengths, out=np.zeros(rows.shape), where=lengths > 0)

    return in_blocks(lambda q, d: 1 - q @ d.T, queries, database, block=BLOCK, prepare=unit)


def correlate(
    queries: Float32[np.ndarray, "q rings sectors"], database: Float32[np.ndarray, "n rings sectors"]
) -> Float32[np.ndarray, "q n sectors"]:
    """Return the sums over rings r and sectors j of queries[r, j] * database[r, j + shift], for all circular shifts."""
    query_spectra = np.moveaxis(np.fft.rfft(queries), -1, 0)  # frequency, query, ring
    database_spectra = np.moveaxis(np.fft.rfft(database), -1, 0)
    products = query_spectra.conj() @ database_spectra.swapaxes(1, 2)  # frequency, query, database
    return np.fft.irfft(np.moveaxis(products, 0, -1), n=queries.shape[-1])


def unit_length(vectors: Float[np.ndarray, "n d"]) -> Float32[np.ndarray, "n d"]:
    """Return each vector divided by its length. Zero vectors stay zero."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0).astype(np.float32)
