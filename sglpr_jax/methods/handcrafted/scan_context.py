"""Scan Context (Kim and Kim, 2018): the maximum height in every cell of a polar grid, compared over all rotations."""

import numpy as np
from jaxtyping import Float32

from sglpr_jax.methods.cells import extreme_of_cells, polar
from sglpr_jax.methods.pairwise import correlate, in_blocks

RINGS = 20
SECTORS = 60
RADIUS_M = 80.0
LIDAR_HEIGHT_M = 2.0
"""Height added to z, in metres, so that the ground is near 0 and heights are positive."""
NUMBERS = RINGS * SECTORS

BLOCK = 256


def scan_context(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "1200"]:
    """Return the maximum of z + 2 m in each of 20 rings x 60 sectors, flattened, and 0 in cells without points.

    Points (metres, z up) beyond 80 m are ignored. A cell includes its outer and its counter-clockwise border.
    """
    radius, angle, z = polar(points)
    inside = radius <= RADIUS_M
    ring = np.clip(np.ceil(radius / RADIUS_M * RINGS), 1, RINGS).astype(np.int64) - 1
    sector = np.clip(np.ceil(angle % (2 * np.pi) / (2 * np.pi) * SECTORS), 1, SECTORS).astype(np.int64) - 1
    cell = (ring * SECTORS + sector)[inside]
    return extreme_of_cells(np.maximum, (NUMBERS,), cell, z[inside] + LIDAR_HEIGHT_M).astype(np.float32)


def scan_context_distance(
    queries: Float32[np.ndarray, "q 1200"], database: Float32[np.ndarray, "n 1200"]
) -> Float32[np.ndarray, "q n"]:
    """Return 1 - (the mean cosine of the sectors of two scans), at the best of all 60 rotations (equations 6 and 7).

    The mean is over the sectors that have points in both scans. Without such sectors, the distance is 1. The published
    search tries fewer rotations and scans.
    """

    def compare(queries, database):
        (query_sectors, query_is_nonempty), (database_sectors, database_is_nonempty) = queries, database
        cosine_sums = correlate(query_sectors, database_sectors)
        shared_sectors = np.rint(correlate(query_is_nonempty, database_is_nonempty))
        means = np.divide(cosine_sums, shared_sectors, out=np.zeros_like(cosine_sums), where=shared_sectors > 0)
        return 1 - means.max(axis=-1)

    return in_blocks(compare, queries, database, block=BLOCK, prepare=_unit_sectors)


def _unit_sectors(
    descriptors: Float32[np.ndarray, "n 1200"],
) -> tuple[Float32[np.ndarray, "n 20 60"], Float32[np.ndarray, "n 1 60"]]:
    """Return the sectors, each scaled to length 1 over its rings, and 1 for nonempty and 0 for empty sectors."""
    images = descriptors.reshape(-1, RINGS, SECTORS)
    lengths = np.linalg.norm(images, axis=1, keepdims=True)
    unit = np.divide(images, lengths, out=np.zeros_like(images), where=lengths > 0)
    return unit, (lengths > 0).astype(np.float32)
