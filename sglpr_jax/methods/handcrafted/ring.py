"""RING (Lu et al., 2023): spectra of the Radon transform of an occupancy image, compared over all rotations.

A translation of the scan shifts each row of the Radon transform, which leaves the magnitudes of the row's spectrum. A
rotation shifts the order of the rows, so the distance compares all shifts.
"""

import numpy as np
from jaxtyping import Float32, Float64

from sglpr_jax.methods.pairwise import correlate, in_blocks

SIDE = 120
"""Number of cells along each side of the image, and number of line offsets in the Radon transform."""
HALF_WIDTH_M = 70.0
LOWEST_M, HIGHEST_M = -1.0, 10.0
"""Heights of the points that count, in metres above the sensor: the published limits for KITTI."""
ANGLES = 60
"""Number of angles, from 0 to 177 degrees. The published angles from 180 degrees on have equal magnitudes again."""
FREQUENCIES = SIDE // 2 + 1

BLOCK = 64


def ring(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "3660"]:
    """Return the magnitudes of the spectrum of each row of the `sinogram`, 60 angles x 61 frequencies, flattened."""
    spectrum = np.abs(np.fft.rfft(sinogram(points), axis=1, norm="ortho"))
    return spectrum.astype(np.float32).ravel()


def sinogram(points: Float32[np.ndarray, "n 3"]) -> Float64[np.ndarray, "60 120"]:
    """Return the Radon transform of the occupied cells within the largest circle of an image of 140 m x 140 m.

    A cell is occupied if it has a point (metres, z up) between 1 m below and 10 m above the sensor. The value at angle
    a and offset s is the number of occupied cells on the line x cos(a) + y sin(a) = s. A cell between two offsets
    counts in both, in proportion to its nearness.
    """
    xy, z = points[:, :2], points[:, 2]
    inside = (z > LOWEST_M) & (z < HIGHEST_M) & (np.abs(xy) < HALF_WIDTH_M).all(axis=1)
    cells = np.floor((xy[inside].astype(np.float64) / HALF_WIDTH_M + 1) * SIDE / 2).astype(np.int64)
    is_occupied = np.bincount(cells @ [SIDE, 1], minlength=SIDE**2).reshape(SIDE, SIDE) > 0
    centres = np.stack(is_occupied.nonzero()) - (SIDE - 1) / 2
    x, y = centres[:, np.hypot(*centres) < (SIDE - 1) / 2]
    angle = np.radians(180 / ANGLES * np.arange(ANGLES))[:, None]
    offset = np.cos(angle) * x[None] + np.sin(angle) * y[None] + (SIDE - 1) / 2
    lower_offset = np.floor(offset).astype(np.int64)
    lower_bin, upper_weight = lower_offset + SIDE * np.arange(ANGLES)[:, None], offset - lower_offset
    lower_sums = np.bincount(lower_bin.ravel(), (1 - upper_weight).ravel(), minlength=ANGLES * SIDE)
    upper_sums = np.bincount((lower_bin + 1).ravel(), upper_weight.ravel(), minlength=ANGLES * SIDE)
    return (lower_sums + upper_sums).reshape(ANGLES, SIDE).astype(np.float64)  # no points would give integers


def ring_distance(
    queries: Float32[np.ndarray, "q 3660"], database: Float32[np.ndarray, "n 3660"]
) -> Float32[np.ndarray, "q n"]:
    """Return 1 minus the highest correlation coefficient of two descriptors over all shifts of the angles, from 0 to 2.

    A descriptor has the magnitudes of the sinogram's spectrum by angle and frequency. One without points has the
    distance 1 from every other. The published distance is 1 - m / (0.15 sqrt(120)), where m sums the absolute value of
    each frequency's correlation over the frequencies. This function sums the correlations with their signs.
    """

    def compare(queries, database):
        return 1 - correlate(queries, database).max(axis=-1)

    return in_blocks(compare, queries, database, block=BLOCK, prepare=_standardise)


def _standardise(descriptors: Float32[np.ndarray, "n 3660"]) -> Float32[np.ndarray, "n 61 60"]:
    """Return magnitudes (frequency, angle) with mean 0 and length 1 over all 120 frequencies of the full spectrum."""
    occurrences = np.full(FREQUENCIES, 2.0)
    occurrences[[0, -1]] = 1  # in the full spectrum, all but the first and the last of the 61 frequencies occur twice
    magnitudes = descriptors.reshape(-1, ANGLES, FREQUENCIES).astype(np.float64)
    mean = (magnitudes @ occurrences).sum(axis=1) / (ANGLES * SIDE)
    scaled = (magnitudes - mean[:, None, None]) * np.sqrt(occurrences)
    length = np.sqrt((scaled**2).sum(axis=(1, 2), keepdims=True))
    unit = np.divide(scaled, length, out=np.zeros_like(scaled), where=length > 0)
    return unit.swapaxes(1, 2).astype(np.float32)
