"""LiDAR Iris (Wang et al., 2020): the scan as an iris, its texture as bits, compared by a shifted Hamming distance."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex128, Float, Float32, Float64, Int, UInt64

from sglpr_jax.methods.method import HandcraftedMethod
from sglpr_jax.methods.pairwise import in_blocks
from sglpr_jax.methods.phase_correlation import Spectra, column_shifts, spectra

RINGS = 80
COLUMNS = 360
RING_M = 1.0
HEIGHT_BITS = 8
LOWEST_DEG = -24.0
"""Elevation at which the first of the height bits begins: the HDL-64E's; a 16-beam sensor's would be -15."""
BIT_DEG = 4.0
NUMBERS = RINGS * COLUMNS

WAVELENGTHS = tuple(18 * 1.6**scale for scale in range(4))
"""In columns, of the four log-Gabor filters."""
SIGMA = 0.75
"""Width of a filter: its standard deviation over its frequency."""
FAINT = 1e-4 / COLUMNS
"""Responses below it have no certain sign. The published 1e-4 is that of an inverse transform without 1 / columns."""
NEAR = 2
"""Columns that are tried to either side of each alignment."""

BLOCK = 128


def lidar_iris(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "28800"]:
    """Return the LiDAR-Iris image, 80 rings of 1 m x 360 degrees, flat: whole numbers 0 to 255.

    Bit k of a pixel is set where it has a point (metres, z up) with floor((elevation + 24 degrees) / 4 degrees) = k;
    lower and higher elevations count for the first and the last bit, points from 79 m on for the last ring. Columns are
    degrees from the back, rounded to the nearest; what is nearest to 360 counts for column 359, not for 0.
    """
    x, y, z = points.astype(np.float64).T
    radius, azimuth = np.hypot(x, y), 180 + np.degrees(np.arctan2(y, x))
    ring = np.minimum(radius / RING_M, RINGS - 1).astype(np.int64)
    column = np.minimum(azimuth + 0.5, COLUMNS - 1).astype(np.int64)
    elevation = np.degrees(np.arctan2(z, radius))
    bit = np.clip((elevation - LOWEST_DEG) / BIT_DEG, 0, HEIGHT_BITS - 1).astype(np.int64)
    image = np.zeros(NUMBERS, np.int64)
    np.bitwise_or.at(image, ring * COLUMNS + column, 1 << bit)
    return image.astype(np.float32)


class _Iris(NamedTuple):
    """What is compared of n images. The words of a column hold its bits of all rings, filters and parts."""

    spectra: Spectra
    bits: UInt64[np.ndarray, "n 360 words"]
    faint: UInt64[np.ndarray, "n 360 words"]


def lidar_iris_distance(
    queries: Float32[np.ndarray, "q 28800"], database: Float32[np.ndarray, "n 28800"]
) -> Float32[np.ndarray, "q n"]:
    """Return the smallest Hamming distance, 0 to 1, over the shifts within 2 columns of an alignment.

    D = min over shifts of |(q xor d) and not m| / |not m|, over the bits of 80 x 360 pixels x 4 filters x 2 parts: the
    signs of the real and of the imaginary part of the log-Gabor response. m marks bits that are faint in either image.
    It is 1 where all are. There are two alignments, by `phase_correlation.column_shifts`.
    """

    def compare(queries, database):
        shifts = np.asarray(column_shifts(queries.spectra, database.spectra))
        return np.stack(
            [_hamming(bits, faint, database, row) for bits, faint, row in zip(*queries[1:], shifts, strict=True)]
        )

    return in_blocks(compare, queries, database, block=BLOCK, prepare=_prepare, threads=None)


def responses(image: Float64[np.ndarray, "80 360"]) -> Complex128[np.ndarray, "filters 80 360"]:
    """Return the complex log-Gabor responses of every ring.

    A filter of wavelength w has the gain exp(-ln(f w)^2 / (2 ln(sigma)^2)) at the frequency f > 0, and 0 elsewhere.
    """
    frequency = np.fft.fftfreq(COLUMNS)
    positive = frequency > 0
    gains = np.zeros((len(WAVELENGTHS), COLUMNS))
    ratio = np.log(np.outer(WAVELENGTHS, frequency[positive]))
    gains[:, positive] = np.exp(-(ratio**2) / (2 * np.log(SIGMA) ** 2))
    return np.fft.ifft(np.fft.fft(image)[None] * gains[:, None])


def _prepare(rows: Float32[np.ndarray, "n 28800"]) -> _Iris:
    images = rows.reshape(-1, RINGS, COLUMNS)
    bits, faint = zip(*map(_encode, images), strict=True)
    return _Iris(spectra(jnp.asarray(images) / 255), np.stack(bits), np.stack(faint))


def _encode(image: Float32[np.ndarray, "80 360"]) -> tuple[UInt64[np.ndarray, "360 words"], ...]:
    """Return the signs of an image's responses, and which of them are faint."""
    found = responses(image.astype(np.float64))
    faint = np.abs(found) < FAINT
    return _pack(np.stack([np.real(found) > 0, np.imag(found) > 0])), _pack(np.stack([faint, faint]))


def _pack(bits: Bool[np.ndarray, "parts filters 80 360"]) -> UInt64[np.ndarray, "360 words"]:
    """Return the bits of every column as words of 64."""
    by_column = bits.reshape(-1, COLUMNS).T
    return np.ascontiguousarray(np.packbits(by_column, axis=-1)).view(np.uint64)


def _hamming(
    bits: UInt64[np.ndarray, "360 words"],
    faint: UInt64[np.ndarray, "360 words"],
    database: _Iris,
    shifts: Int[np.ndarray, "n 2"],
) -> Float[np.ndarray, " n"]:
    """Return the distance of one image to each of the database, at the best shift near its alignments.

    These are mostly a column apart: most shifts near the one are near the other, and count once.
    """
    near = np.sort((shifts[..., None] + np.arange(-NEAR, NEAR + 1)).reshape(len(shifts), -1) % COLUMNS, axis=1)
    best = np.ones(len(shifts))
    for shift, new in zip(near.T, (np.diff(near, axis=1, prepend=-1) > 0).T, strict=True):
        columns = (np.arange(COLUMNS) + shift[new, None]) % COLUMNS
        there = new.nonzero()[0][:, None], columns
        clear = ~(faint | database.faint[there])
        unlike = np.bitwise_count((bits ^ database.bits[there]) & clear).sum(axis=(1, 2), dtype=np.int64)
        counted = np.bitwise_count(clear).sum(axis=(1, 2), dtype=np.int64)
        found = np.divide(unlike, counted, out=np.ones(len(columns)), where=counted > 0)
        best[new] = np.minimum(best[new], found)
    return best


LIDAR_IRIS = HandcraftedMethod(
    "lidar-iris",
    'Wang et al., "LiDAR Iris for Loop-Closure Detection", IROS 2020',
    "points",
    lidar_iris,
    distance=lidar_iris_distance,
)
