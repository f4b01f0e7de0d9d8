"""LiDAR Iris (Wang et al., 2020): the scan as an iris image with a binary texture, compared by a shifted Hamming
distance."""

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
"""Elevation at which the first height bit begins, for the HDL-64E. A 16-beam sensor would need -15."""
BIT_DEG = 4.0
NUMBERS = RINGS * COLUMNS

WAVELENGTHS = tuple(18 * 1.6**scale for scale in range(4))
"""Wavelengths of the four log-Gabor filters, in columns."""
SIGMA = 0.75
"""Width of a filter: its standard deviation divided by its frequency."""
FAINT = 1e-4 / COLUMNS
"""Amplitude below which the sign of a response is unreliable. The published 1e-4 belongs to an inverse transform
without the factor 1 / columns."""
NEAR = 2
"""Number of columns to either side of each alignment that are also compared."""

BLOCK = 128


def lidar_iris(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "28800"]:
    """Return the LiDAR-Iris image, 80 rings of 1 m x 360 degrees, flattened: integers from 0 to 255.

    Bit k of a pixel is set if the pixel has a point (metres, z up) with floor((elevation + 24 degrees) / 4 degrees) =
    k. Lower elevations count in the first bit, higher ones in the last, and points from 79 m on in the last ring.
    Columns are degrees from the back, rounded to the nearest. Azimuths that round to 360 count in column 359, not in
    column 0.
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
    """Prepared data of n images. The words of a column hold its bits of all rings, filters and parts."""

    spectra: Spectra
    bits: UInt64[np.ndarray, "n 360 words"]
    faint: UInt64[np.ndarray, "n 360 words"]


def lidar_iris_distance(
    queries: Float32[np.ndarray, "q 28800"], database: Float32[np.ndarray, "n 28800"]
) -> Float32[np.ndarray, "q n"]:
    """Return the smallest Hamming distance, from 0 to 1, over the shifts within 2 columns of an alignment.

    D = min over shifts of |(q xor d) and not m| / |not m|. The bits are the signs of the real and the imaginary part of
    the log-Gabor response: 80 x 360 pixels x 4 filters x 2 parts. m marks bits that are faint in either image. If all
    bits are faint, the distance is 1. `phase_correlation.column_shifts` gives two alignments.
    """

    def compare(queries, database):
        shifts = np.asarray(column_shifts(queries.spectra, database.spectra))
        return np.stack(
            [_hamming(bits, faint, database, row) for bits, faint, row in zip(*queries[1:], shifts, strict=True)]
        )

    return in_blocks(compare, queries, database, block=BLOCK, prepare=_prepare, threads=None)


def responses(image: Float64[np.ndarray, "80 360"]) -> Complex128[np.ndarray, "filters 80 360"]:
    """Return the complex log-Gabor responses of every ring.

    A filter of wavelength w has the gain exp(-ln(f w)^2 / (2 ln(sigma)^2)) at frequencies f > 0, and 0 elsewhere.
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
    """Return the signs of an image's responses, and a mask of the faint ones."""
    found = responses(image.astype(np.float64))
    faint = np.abs(found) < FAINT
    return _pack(np.stack([np.real(found) > 0, np.imag(found) > 0])), _pack(np.stack([faint, faint]))


def _pack(bits: Bool[np.ndarray, "parts filters 80 360"]) -> UInt64[np.ndarray, "360 words"]:
    """Return the bits of every column as words of 64 bits."""
    by_column = bits.reshape(-1, COLUMNS).T
    return np.ascontiguousarray(np.packbits(by_column, axis=-1)).view(np.uint64)


def _hamming(
    bits: UInt64[np.ndarray, "360 words"],
    faint: UInt64[np.ndarray, "360 words"],
    database: _Iris,
    shifts: Int[np.ndarray, "n 2"],
) -> Float[np.ndarray, " n"]:
    """Return the distance of one image to each image of the database, at the best shift near its alignments.

    The two alignments are mostly one column apart, so most shifts occur twice and are compared once.
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
