"""RING (Lu et al., 2023): spectra of the Radon transform of an occupancy image, compared over all rotations.

A translation of the scan shifts every row of the Radon transform along the offsets, which its magnitudes ignore. A
rotation shifts the rows, which the distance compares at all shifts.
"""

import numpy as np
from jaxtyping import Float32, Float64

from sglpr_jax.methods.pairwise import correlate, in_blocks

SIDE = 120
"""Number of cells along each side of the image, and number of offsets."""
HALF_WIDTH_M = 70.0
LOWEST_M, HIGHEST_M = -1.0, 10.0
"""Heights of the points that count, in metres above the sensor: the published limits for KITTI."""
ANGLES = 60
"""Number of angles, from 0 to 177 degrees. The published 120 angles cover 360 degrees; the second half has the rows of
the first half in reverse, and therefore equal magnitudes."""
FREQUENCIES = SIDE // 2 + 1
NUMBERS = ANGLES * FREQUENCIES

BLOCK = 64


def ring(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "3660"]:
    """Return the magnitudes of 60 angles x 61 frequencies of `sinogram`, scaled by 1 / sqrt(120) and flattened."""
    spectrum = np.abs(np.fft.rfft(sinogram(points), axis=1, norm="ortho"))
    return spectrum.astype(np.float32).ravel()


def sinogram(points: Float32[np.ndarray, "n 3"]) -> Float64[np.ndarray, "60 120"]:
    """Return the Radon transform of the occupied cells within the largest circle of the image.

    The image has 120 x 120 cells over 140 m x 140 m. A cell is occupied if it has a point (metres, z up) between 1 m
    below and 10 m above the sensor. The value at angle a and offset s is the number of cells on the line with x cos(a)
    + y sin(a) = s. A cell between two offsets counts in both, in proportion to its nearness.
    """
    inside = (points[:, 2] > LOWEST_M) & (points[:, 2] < HIGHEST_M) & (np.abs(points[:, :2]) < HALF_WIDTH_M).all(axis=1)
    cells = np.floor((points[inside, :2].astype(np.float64) / HALF_WIDTH_M + 1) * SIDE / 2).astype(np.int64)
    occupied = np.bincount(cells @ [SIDE, 1], minlength=SIDE**2).reshape(SIDE, SIDE) > 0
    centres = np.stack(occupied.nonzero()) - (SIDE - 1) / 2
    x, y = centres[:, np.hypot(*centres) < (SIDE - 1) / 2]
    angle = np.radians(180 / ANGLES * np.arange(ANGLES))[:, None]
    offset = np.cos(angle) * x[None] + np.sin(angle) * y[None] + (SIDE - 1) / 2
    low = np.floor(offset).astype(np.int64)
    flat, share = low + SIDE * np.arange(ANGLES)[:, None], offset - low
    lines = np.zeros(ANGLES * SIDE)
    for step, weight in ((0, 1 - share), (1, share)):
        lines += np.bincount((flat + step).ravel(), weight.ravel(), minlength=ANGLES * SIDE)
    return lines.reshape(ANGLES, SIDE)


def ring_distance(
    queries: Float32[np.ndarray, "q 3660"], database: Float32[np.ndarray, "n 3660"]
) -> Float32[np.ndarray, "q n"]:
    """Return 1 - (the highest correlation coefficient of the magnitudes over all shifts of the angles), from 0 to 2.

    All 120 frequencies count. A descriptor without points has the distance 1 from every other. The published distance
    is 1 - m / (0.15 sqrt(120)), where m sums the absolute values of the correlations of the frequencies. This function
    sums the correlations.
    """

    def compare(queries, database):
        return 1 - correlate(queries, database).max(axis=-1)

    return in_blocks(compare, queries, database, block=BLOCK, prepare=_standardise)


def _standardise(rows: Float32[np.ndarray, "n 3660"]) -> Float32[np.ndarray, "n 61 60"]:
    """Return the magnitudes with mean 0 and length 1 over all 120 frequencies. 59 of them occur twice."""
    occurrences = np.full(FREQUENCIES, 2.0)
    occurrences[[0, -1]] = 1
    magnitudes = rows.reshape(-1, ANGLES, FREQUENCIES).astype(np.float64)
    mean = (magnitudes @ occurrences).sum(axis=1) / (ANGLES * SIDE)
    weighted = (magnitudes - mean[:, None, None]) * np.sqrt(occurrences)
    length = np.sqrt((weighted**2).sum(axis=(1, 2), keepdims=True))
    unit = np.divide(weighted, length, out=np.zeros_like(weighted), where=length > 0)
    return unit.swapaxes(1, 2).astype(np.float32)
