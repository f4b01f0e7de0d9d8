"""LiDAR Iris (Wang et al., 2020): a polar image whose binary texture is compared by a shifted Hamming distance."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Complex, Complex128, Float, Float32, Float64, Int, UInt64

from sglpr_jax.methods.cells import polar
from sglpr_jax.methods.pairwise import in_blocks

RINGS = 80
COLUMNS = 360
RING_M = 1.0
HEIGHT_BITS = 8
LOWEST_DEG = -24.0
"""Elevation at which the first height bit begins, for the HDL-64E. A 16-beam sensor would need -15."""
BIT_DEG = 4.0

WAVELENGTHS = tuple(18 * 1.6**scale for scale in range(4))
"""Wavelengths of the four log-Gabor filters, in columns."""
SIGMA = 0.75
"""Width of a filter: its standard deviation divided by its frequency."""
FAINT = 1e-4 / COLUMNS
"""Amplitude below which the sign of a response is unreliable. The published 1e-4 belongs to an inverse transform
without the factor 1 / columns."""
NEAR = 2
"""Number of columns to either side of each alignment that are also compared."""

LARGEST_SCALE = 1.8
"""Maximum scale. A larger one is considered the inverse of the true scale."""
PEAK_CELLS = 2
"""Distance from the peak, in cells, within which its centre of mass is computed."""
SMALL = float(np.finfo(np.float32).eps)
"""Added to squared amplitudes before division, so that faint frequencies have less weight."""
LOG_BASE = float(np.hypot(RINGS // 2, COLUMNS // 2) ** (1 / COLUMNS))
"""Ratio of the radii of neighbouring columns of the log-polar spectrum."""

BLOCK = 128


def lidar_iris(points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "28800"]:
    """Return the LiDAR-Iris image, 80 rings of 1 m x 360 degrees, flattened: integers from 0 to 255.

    Bit k of a pixel is set if the pixel has a point (metres, z up) with floor((elevation + 24 degrees) / 4 degrees) =
    k. Elevations and ranges beyond the limits count in the nearest bit and ring. Columns are degrees from the back,
    rounded to the nearest. Azimuths that round to 360 count in column 359.
    """
    radius, azimuth, z = polar(points)
    ring = np.minimum(radius / RING_M, RINGS - 1).astype(np.int64)
    column = np.minimum(180 + np.degrees(azimuth) + 0.5, COLUMNS - 1).astype(np.int64)
    elevation = np.degrees(np.arctan2(z, radius))
    bit = np.clip((elevation - LOWEST_DEG) / BIT_DEG, 0, HEIGHT_BITS - 1).astype(np.int64)
    image = np.zeros(RINGS * COLUMNS, np.int64)
    np.bitwise_or.at(image, ring * COLUMNS + column, 1 << bit)
    return image.astype(np.float32)


class Spectra(NamedTuple):
    """An image, its spectrum, and the spectrum of its log-polar amplitudes."""

    image: Float[Array, "*n 80 360"]
    spectrum: Complex[Array, "*n 80 181"]
    log_polar: Complex[Array, "*n 80 181"]


Words = UInt64[np.ndarray, "... 360 words"]
"""The bits of each column: of all rings, filters and parts."""


def lidar_iris_distance(
    queries: Float32[np.ndarray, "q 28800"], database: Float32[np.ndarray, "n 28800"]
) -> Float32[np.ndarray, "q n"]:
    """Return the smallest Hamming distance, from 0 to 1, over the shifts within 2 columns of an alignment.

    D = min over shifts of |(q xor d) and not m| / |not m|. The bits are the signs of the real and the imaginary part of
    the log-Gabor response: 80 x 360 pixels x 4 filters x 2 parts. m marks bits that are faint in either image. If all
    bits are faint, the distance is 1. `column_shifts` gives two alignments.
    """

    def compare(queries, database):
        (query_spectra, bits, faint), (database_spectra, *database_words) = queries, database
        shifts = np.asarray(column_shifts(query_spectra, database_spectra))
        return np.stack([_hamming(*query, *database_words) for query in zip(bits, faint, shifts, strict=True)])

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


def _prepare(rows: Float32[np.ndarray, "n 28800"]) -> tuple[Spectra, Words, Words]:
    """Return the spectra of the images, the signs of their responses, and a mask of the faint ones."""

    def pack(bits):  # (parts, filters, 80, 360)
        return np.ascontiguousarray(np.packbits(bits.reshape(-1, COLUMNS).T, axis=-1)).view(np.uint64)

    images, signs, faint = rows.reshape(-1, RINGS, COLUMNS), [], []
    for image in images:
        response = responses(image.astype(np.float64))
        signs.append(pack(np.stack([np.real(response) > 0, np.imag(response) > 0])))
        faint.append(pack(np.stack([np.abs(response) < FAINT] * 2)))
    return spectra(jnp.asarray(images) / 255), np.stack(signs), np.stack(faint)


def _hamming(
    bits: Words, faint: Words, shifts: Int[np.ndarray, "n 2"], database_bits: Words, database_faint: Words
) -> Float[np.ndarray, " n"]:
    """Return the distance of one image to each image of the database, at the best shift near its two alignments.

    The two alignments are mostly one column apart, so most shifts occur twice and are compared once.
    """
    near = np.sort((shifts[..., None] + np.arange(-NEAR, NEAR + 1)).reshape(len(shifts), -1) % COLUMNS, axis=1)
    best = np.ones(len(shifts))
    for shift, is_new in zip(near.T, (np.diff(near, axis=1, prepend=-1) > 0).T, strict=True):
        columns = (np.arange(COLUMNS) + shift[is_new, None]) % COLUMNS
        shifted = is_new.nonzero()[0][:, None], columns
        clear = ~(faint | database_faint[shifted])
        unequal = np.bitwise_count((bits ^ database_bits[shifted]) & clear).sum(axis=(1, 2), dtype=np.int64)
        counted = np.bitwise_count(clear).sum(axis=(1, 2), dtype=np.int64)
        distance = np.divide(unequal, counted, out=np.ones(len(columns)), where=counted > 0)
        best[is_new] = np.minimum(best[is_new], distance)
    return best


@jax.jit
def spectra(images: Float[Array, "n 80 360"]) -> Spectra:
    """Return the spectra of images.

    The log-polar image has half a revolution of angles by radii. Its amplitudes have the gain (1 - c) (2 - c), where c
    is the product of two half cosines.
    """
    low = np.outer(*(np.cos(np.pi * (np.arange(size) / size - 0.5)) for size in (RINGS, COLUMNS)))
    gain = ((1 - low) * (2 - low)).astype(np.float32)
    angle = np.pi / 2 + np.pi * np.arange(RINGS)[:, None] / RINGS
    radius = LOG_BASE ** np.arange(COLUMNS)[None, :]
    pixels = np.stack([RINGS // 2 + radius * np.cos(angle), COLUMNS // 2 + radius * np.sin(angle)]).astype(np.float32)

    def image_spectra(image):
        amplitudes = jnp.fft.fftshift(jnp.abs(jnp.fft.fft2(image))) / image.size * gain
        return Spectra(image, jnp.fft.rfft2(image), jnp.fft.rfft2(map_coordinates(amplitudes, list(pixels), order=1)))

    return jax.lax.map(image_spectra, images)


@jax.jit
def column_shifts(queries: Spectra, database: Spectra) -> Int[Array, "q n 2"]:
    """Return two estimates of the shift to the right, in columns, that aligns each query with each database image.

    The query is first rotated and scaled according to the log-polar spectra. The first estimate is the position of the
    correlation peak, rounded towards 0. For the second, the database image is rolled by half its columns, so that the
    peak is rounded in the opposite direction and may be cut by the border.
    """

    def shifts(query, other):
        aligned = jnp.fft.rfft2(_rotate_and_scale(query.image, *rotation_and_scale(query, other)))
        surface = _correlation(aligned, other.spectrum)
        estimates = [_peak(surface, (RINGS // 2, columns))[1] for columns in (COLUMNS // 2, 0)]
        return jnp.stack(estimates).astype(jnp.int32) - jnp.array([0, COLUMNS // 2])

    return jax.lax.map(lambda query: jax.lax.map(lambda other: shifts(query, other), database), queries)


def rotation_and_scale(query: Spectra, other: Spectra) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the rotation that aligns the query, in radians, and the size of the query relative to the other image."""
    down, right = _peak(_correlation(query.log_polar, other.log_polar), (RINGS // 2, COLUMNS // 2))
    angle, scale = jnp.pi * down / RINGS, LOG_BASE**right
    is_inverse = scale > LARGEST_SCALE
    return jnp.where(is_inverse, -angle, angle), jnp.where(is_inverse, 1 / scale, scale)


def _correlation(a: Complex[Array, "80 181"], b: Complex[Array, "80 181"]) -> Float[Array, "80 360"]:
    """Return the phase correlation. The offset of its peak from the corner is the shift that moves b onto a."""
    cross = a * jnp.conj(b)
    amplitude = jnp.abs(cross)
    return jnp.fft.irfft2(cross * amplitude / (amplitude**2 + SMALL), (RINGS, COLUMNS))


def _peak(surface: Float[Array, "80 360"], roll: tuple[int, int]) -> Float[Array, "2"]:
    """Return the offset of the middle, down and right, from the centre of mass of the peak in the surface rolled by
    `roll` rows and columns. The borders of this surface cut the peak."""
    shape = np.array(surface.shape)
    # The first maximum, in an eighth of the time of `jnp.argmax` on a CPU.
    first = jnp.where(surface.ravel() == surface.max(), jnp.arange(surface.size), surface.size).min()
    peak = jnp.stack(jnp.divmod(first, COLUMNS))
    rolled_peak = (peak + np.array(roll)) % shape
    steps = np.arange(-PEAK_CELLS, PEAK_CELLS + 1)
    row, column = (peak[:, None] + steps[None]) % shape[:, None]
    inside = (rolled_peak[:, None] + steps[None] >= 0) & (rolled_peak[:, None] + steps[None] < shape[:, None])
    window = jnp.where(inside[0][:, None] & inside[1][None], surface[row[:, None], column[None]], 0.0)
    total = window.sum()
    mean = jnp.stack([window.sum(axis=1) @ steps, window.sum(axis=0) @ steps]) / jnp.where(total == 0, 1.0, total)
    return jnp.asarray(shape // 2) - rolled_peak - mean


def _rotate_and_scale(
    image: Float[Array, "80 360"], angle: Float[Array, ""], scale: Float[Array, ""]
) -> Float[Array, "80 360"]:
    """Return the image, rotated about its middle and shrunk by `scale`, with zeros outside."""
    down, right = np.mgrid[-RINGS // 2 : RINGS // 2, -COLUMNS // 2 : COLUMNS // 2]
    cos, sin = scale * jnp.cos(angle), scale * jnp.sin(angle)
    pixels = [RINGS // 2 + sin * right + cos * down, COLUMNS // 2 + cos * right - sin * down]
    return map_coordinates(image, pixels, order=1)
