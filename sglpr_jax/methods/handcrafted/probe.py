"""PROBE (Lee et al., 2026), rebuilt from the abstract with own formulas: occupancy and heights on a polar grid."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Float64, Int

from sglpr_jax.methods.cells import extreme_of_cells, polar
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
AZIMUTH_DEVIATIONS = MOVE_M / ((np.arange(RINGS) + 0.5) * (RADIUS_M / RINGS))
"""Standard deviation of the azimuth in each ring, in radians."""

BLOCK = 64
Cells = Float32[np.ndarray, "n 40 60"]


def probe(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "2400"]:
    """Return the maximum height above the ground, from 0.3 m on, in each of 40 rings x 60 sectors, or 0, flattened."""
    radius, angle, z = polar(points)
    height = z - GROUND_M
    valid = (radius < RADIUS_M) & (height > CLEARANCE_M)
    ring = np.floor(radius * (RINGS / RADIUS_M)).astype(np.int64)
    sector = np.floor(angle * (SECTORS / (2 * np.pi))).astype(np.int64) % SECTORS
    cell = (ring * SECTORS + sector)[valid]
    return extreme_of_cells(np.maximum, (RINGS * SECTORS,), cell, height[valid]).astype(np.float32)


def occupancy(heights: Cells) -> Float64[np.ndarray, "n 40 60"]:
    """Return probabilities of occupancy: the occupied cells, blurred along the sectors (`AZIMUTH_DEVIATIONS`)."""
    sector_angles = np.minimum(np.arange(SECTORS), SECTORS - np.arange(SECTORS)) * (2 * np.pi / SECTORS)
    kernel = np.exp(-((sector_angles[None] / AZIMUTH_DEVIATIONS[:, None]) ** 2) / 2)
    spectrum = np.fft.rfft(kernel / kernel.sum(axis=1, keepdims=True))
    return np.fft.irfft(np.fft.rfft(heights > 0) * spectrum[None], n=SECTORS).clip(0, 1)


def probe_distance(
    queries: Float32[np.ndarray, "q 2400"], database: Float32[np.ndarray, "n 2400"]
) -> Float32[np.ndarray, "q n"]:
    """Return 1 - (Jaccard index) * (cosine similarity of the heights), at the rotation with the highest cosine.

    The Jaccard index of two scans, whose cells are occupied with the probabilities p and q, is

        sum of w max(p, q) exp(-KL(p', q') - KL(q', p')) / sum of w max(p, q).

    p' and q' are smoothed (`_prepare`), and KL is the divergence of two Bernoulli distributions. The cells of a ring
    have the weight w = exp(-azimuth deviation / 6 degrees). A scan without points has the distance 1 from every other.
    """

    def compare(queries, database):
        (query_heights, *query_probabilities), (database_heights, *database_probabilities) = queries, database
        cosines = correlate(query_heights, database_heights)
        shifts = cosines.argmax(axis=-1).astype(np.int32)
        jaccard = np.asarray(_jaccard(tuple(query_probabilities), tuple(database_probabilities), shifts))
        return 1 - cosines.max(axis=-1) * jaccard

    return in_blocks(compare, queries, database, block=BLOCK, prepare=_prepare)


def _prepare(descriptors: Float32[np.ndarray, "n 2400"]) -> tuple[Cells, Cells, Cells, Cells]:
    """Return the heights of each scan, scaled to length 1, the occupancy p, the smoothed p', and log(p' / (1 - p')).

    p' = (1 - u) p + u / 2, clipped to 0.01 to 0.99, with the uncertainty u = min(azimuth deviation in radians, 1).
    """
    heights = descriptors.reshape(-1, RINGS, SECTORS)
    occupied = occupancy(heights)
    uncertainty = np.minimum(AZIMUTH_DEVIATIONS, 1)[None, :, None]
    smoothed = ((1 - uncertainty) * occupied + uncertainty / 2).clip(0.01, 0.99)
    logit = np.log(smoothed / (1 - smoothed))
    unit_heights = unit_length(descriptors).reshape(heights.shape)
    return unit_heights, occupied.astype(np.float32), smoothed.astype(np.float32), logit.astype(np.float32)


@jax.jit
def _jaccard(
    queries: tuple[Float[Array, "q 40 60"], ...],
    database: tuple[Float[Array, "n 40 60"], ...],
    shifts: Int[Array, "q n"],
) -> Float[Array, "q n"]:
    """Return the Jaccard indices of p, p' and log(p' / (1 - p')) (`_prepare`), with the query's sectors shifted."""
    weights = np.exp(-AZIMUTH_DEVIATIONS * (SECTORS / (2 * np.pi))).astype(np.float32)[None, :, None]
    shifted_sectors = (np.arange(SECTORS)[None, :] - np.arange(SECTORS)[:, None]) % SECTORS  # shift, sector
    database_occupied, database_smoothed, database_logit = database

    def jaccard_of_query(query):
        *maps, shifts_of_query = query
        # It is fast to compute each map (rings, sectors) at all shifts and to select the shifts of the database.
        all_shifts = (jnp.moveaxis(map_of_query[:, shifted_sectors], 1, 0) for map_of_query in maps)
        occupied, smoothed, logit = (at_shifts[shifts_of_query] for at_shifts in all_shifts)
        divergence = (smoothed - database_smoothed) * (logit - database_logit)  # KL(p', q') + KL(q', p')
        union = weights * jnp.maximum(occupied, database_occupied)
        union_sum = union.sum((1, 2))
        return (union * jnp.exp(-divergence)).sum((1, 2)) / jnp.where(union_sum > 0, union_sum, 1.0)

    return jax.lax.map(jaccard_of_query, (*queries, shifts))
