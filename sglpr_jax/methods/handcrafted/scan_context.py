"""Scan Context (Kim and Kim, 2018): the maximum height in every cell of a polar grid, compared over all rotations."""

import numpy as np
from jaxtyping import Float32

from sglpr_jax.methods.cells import extreme, polar
from sglpr_jax.methods.pairwise import correlate, in_blocks

RINGS = 20
SECTORS = 60
RADIUS_M = 80.0
LIDAR_HEIGHT_M = 2.0
"""Height added to z, in metres, so that the ground is near 0 and heights are positive."""
NUMBERS = RINGS * SECTORS

BLOCK = 256


def scan_context(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "1200"]:
    """Return I[i, j] = max of z + 2 m over the points of a cell, else 0, for 20 rings x 60 sectors, flattened.

    Points (metres, z up) beyond 80 m are ignored. A cell includes its outer and its counter-clockwise border: ring =
    ceil(20 r / 80 m), sector = ceil(60 theta / 360 degrees), from 1.
    """
    radius, angle, z = polar(points)
    inside = radius <= RADIUS_M
    ring = np.clip(np.ceil(radius / RADIUS_M * RINGS), 1, RINGS).astype(np.int64) - 1
    sector = np.clip(np.ceil(angle % (2 * np.pi) / (2 * np.pi) * SECTORS), 1, SECTORS).astype(np.int64) - 1
    cell = (ring * SECTORS + sector)[inside]
    return extreme(np.maximum, (NUMBERS,), cell, z[inside] + LIDAR_HEIGHT_M).astype(np.float32)


def scan_context_distance(
    queries: Float32[np.ndarray, "q 1200"], database: Float32[np.ndarray, "n 1200"]
) -> Float32[np.ndarray, "q n"]:
    """Return the column-wise cosine distance at the best of all 60 rotations (equations 6 and 7).

    D = min over shifts s of 1 - (1 / N_s) sum over j of cos(q_j, d_{j + s}), with columns (sectors) q_j and N_s columns
    that are nonempty in both scans. Without such columns, D is 1. The published search tries fewer shifts and scans.
    """

    def compare(queries, database):
        cosines, shared = correlate(queries[0], database[0]), np.rint(correlate(queries[1], database[1]))
        mean = np.divide(cosines, shared, out=np.zeros_like(cosines), where=shared > 0)
        return 1 - mean.max(axis=-1)

    return in_blocks(compare, queries, database, block=BLOCK, prepare=_unit_columns)


def _unit_columns(
    rows: Float32[np.ndarray, "n 1200"],
) -> tuple[Float32[np.ndarray, "n 20 60"], Float32[np.ndarray, "n 1 60"]]:
    """Return the columns divided by their lengths, and a mask of the nonempty columns."""
    columns = rows.reshape(-1, RINGS, SECTORS)
    lengths = np.linalg.norm(columns, axis=1, keepdims=True)
    unit = np.divide(columns, lengths, out=np.zeros_like(columns), where=lengths > 0)
    return unit, (lengths > 0).astype(np.float32)
