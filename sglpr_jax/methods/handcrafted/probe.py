"""PROBE (Lee et al., 2026), rebuilt from the abstract: probabilities of occupancy and heights on a polar grid.

The abstract names the parts. The formulas that combine them, and all numbers, are choices of this project.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Float64, Int

from sglpr_jax.methods.cells import extreme, polar
from sglpr_jax.methods.pairwise import correlate, in_blocks, unit_length

RINGS = 40
SECTORS = 60
RADIUS_M = 80.0
GROUND_M = -1.73
"""Height of the ground, in metres above the sensor."""
CLEARANCE_M = 0.3
"""Minimum height of the points that count, in metres above the ground."""
MOVE_M = 2.0
"""Standard deviation of the translation between two visits, in metres."""
DEVIATIONS = MOVE_M / ((np.arange(RINGS) + 0.5) * (RADIUS_M / RINGS))
"""Standard deviation of the azimuth in each ring, in radians."""

BLOCK = 64
Cells = Float32[np.ndarray, "n 40 60"]


def probe(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "2400"]:
    """Return the height of 40 rings x 60 sectors above the ground, flattened: the highest point of each cell, or 0.

    Points (metres, z up) below 0.3 m above the ground or from 80 m on are ignored.
    """
    radius, angle, z = polar(points)
    height = z - GROUND_M
    valid = (radius < RADIUS_M) & (height > CLEARANCE_M)
    ring = np.floor(radius * (RINGS / RADIUS_M)).astype(np.int64)
    sector = np.floor(angle * (SECTORS / (2 * np.pi))).astype(np.int64) % SECTORS
    cell = (ring * SECTORS + sector)[valid]
    return extreme(np.maximum, (RINGS * SECTORS,), cell, height[valid]).astype(np.float32)


def occupancy(heights: Cells) -> Float64[np.ndarray, "n 40 60"]:
    """Return the probability of occupancy: the occupied cells, blurred along the sectors by a Gaussian."""
    sectors = np.minimum(np.arange(SECTORS), SECTORS - np.arange(SECTORS)) * (2 * np.pi / SECTORS)
    kernel = np.exp(-((sectors[None] / DEVIATIONS[:, None]) ** 2) / 2)
    spectrum = np.fft.rfft(kernel / kernel.sum(axis=1, keepdims=True))
    return np.fft.irfft(np.fft.rfft(heights > 0) * spectrum[None], n=SECTORS).clip(0, 1)


def probe_distance(
    queries: Float32[np.ndarray, "q 2400"], database: Float32[np.ndarray, "n 2400"]
) -> Float32[np.ndarray, "q n"]:
    """Return 1 - (Jaccard index) * (cosine similarity of the heights), at the rotation with the highest cosine.

    In ring r, u = min(deviation in radians, 1) smooths a probability p to p' = (1 - u) p + u / 2, within 0.01 and 0.99.
    The Jaccard index is

        sum of w max(p, q) exp(-KL(p', q') - KL(q', p')) / sum of w max(p, q),

    where w = exp(-deviation / (6 degrees)) weighs the cells of a ring, and KL is the divergence of two Bernoulli
    distributions. With certain occupancy, this is the Jaccard index of the occupied cells. A scan without points has
    the distance 1 from every other.
    """

    def compare(queries, database):
        cosines = correlate(queries[0], database[0])
        shifts = cosines.argmax(axis=-1).astype(np.int32)
        return 1 - cosines.max(axis=-1) * np.asarray(_jaccard(queries[1:], database[1:], shifts))

    return in_blocks(compare, queries, database, block=BLOCK, prepare=_prepare)


def _prepare(rows: Float32[np.ndarray, "n 2400"]) -> tuple[Cells, ...]:
    """Return the heights, scaled to length 1, p, p', and log(p' / (1 - p'))."""
    heights = rows.reshape(-1, RINGS, SECTORS)
    occupied = occupancy(heights)
    uncertainty = np.minimum(DEVIATIONS, 1)[None, :, None]
    smoothed = ((1 - uncertainty) * occupied + uncertainty / 2).clip(0.01, 0.99)
    parts = (part.astype(np.float32) for part in (occupied, smoothed, np.log(smoothed / (1 - smoothed))))
    return unit_length(rows).reshape(heights.shape), *parts


@jax.jit
def _jaccard(
    queries: tuple[Float[Array, "q 40 60"], ...],
    database: tuple[Float[Array, "n 40 60"], ...],
    shifts: Int[Array, "q n"],
) -> Float[Array, "q n"]:
    """Return the Jaccard index of each pair, with the sectors of the query shifted by `shifts`."""
    weights = np.exp(-DEVIATIONS * (SECTORS / (2 * np.pi))).astype(np.float32)[None, :, None]
    sectors = (np.arange(SECTORS)[None, :] - np.arange(SECTORS)[:, None]) % SECTORS

    def query_row(query):
        *parts, shifts = query
        # A table of all shifts is fast.
        occupied, smoothed, logit = (jnp.moveaxis(part[:, sectors], 1, 0)[shifts] for part in parts)
        divergence = (smoothed - database[1]) * (logit - database[2])  # of both directions together
        union = weights * jnp.maximum(occupied, database[0])
        total = union.sum((1, 2))
        return (union * jnp.exp(-divergence)).sum((1, 2)) / jnp.where(total > 0, total, 1.0)

    return jax.lax.map(query_row, (*queries, shifts))
